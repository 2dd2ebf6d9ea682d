"""The public names, and the parameters of every public function, are what they were.

`python -m tests.test_api` writes them anew: only after a change that is meant to change them.
"""

import inspect
import json
import types
from pathlib import Path

import pytest

import cmedirl_jax as cm

API = Path(__file__).with_name("api.json")


def public(module):
    """Its own public names: those of `__all__`, or those that are defined in it."""
    names = getattr(module, "__all__", None)
    if names is not None:
        return sorted(names)
    return sorted(
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__
    )


def parameters(value):
    """Names of the parameters of a function or class, `*` before those by keyword alone."""
    names, keyword_only = [], False
    for parameter in inspect.signature(value).parameters.values():
        if parameter.kind == parameter.KEYWORD_ONLY and not keyword_only:
            names.append("*")
            keyword_only = True
        names.append(parameter.name)
    return names


def described(module, prefix):
    """Every public function and class below a module by its dotted name."""
    for name in public(module):
        value, dotted = getattr(module, name), f"{prefix}.{name}"
        if isinstance(value, types.ModuleType):
            yield from described(value, dotted)
        elif inspect.isfunction(value) or inspect.isclass(value):
            is_protocol = getattr(value, "_is_protocol", False)
            yield dotted, [] if is_protocol else parameters(value)
        else:
            yield dotted, None


@pytest.fixture(scope="module")
def pinned():
    return json.loads(API.read_text())


def test_the_flat_names_are_reachable(pinned):
    assert public(cm) == pinned["names"]
    for name in pinned["names"]:
        assert getattr(cm, name) is not None


def test_names_and_parameters_are_as_they_were(pinned):
    assert dict(described(cm, "cm")) == pinned["parameters"]


if __name__ == "__main__":
    content = {"names": public(cm), "parameters": dict(described(cm, "cm"))}
    API.write_text(json.dumps(content, indent=1) + "\n")
