import dataclasses
import functools
import operator
import typing

import numpy as np
import pytest

from cmedirl_jax import envs, ranges
from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs import validation
from cmedirl_jax.runs.errors import UserError
from experiments.presets import PRESETS
from experiments.run_grid import parse
from tests.support import pools


def fields(options, prefix=""):
    """Dotted names of the numbers that options may hold, and their ranges."""
    for name, interval in ranges.of_fields(type(options)).items():
        value = getattr(options, name)
        if dataclasses.is_dataclass(value):
            yield from fields(value, f"{prefix}{name}.")
        elif interval is not None:
            yield prefix + name, interval


RANGES = dict(fields(PRESETS["tuned"]))


def numeric(annotation):
    """Whether a field of this type may hold a number."""
    return annotation in (int, float) or any(map(numeric, typing.get_args(annotation)))


def test_every_number_that_the_command_line_takes_has_a_range():
    def unranged(options):
        types = typing.get_type_hints(type(options))
        for name, interval in ranges.of_fields(type(options)).items():
            value = getattr(options, name)
            if dataclasses.is_dataclass(value):
                yield from unranged(value)
            elif interval is None and numeric(types[name]):
                yield name

    assert not list(unranged(PRESETS["tuned"]))
    assert len(RANGES) > 70


@pytest.mark.parametrize("preset", PRESETS)
def test_the_presets_are_in_range(preset):
    validation.check(PRESETS[preset])


def beyond(of_name):
    """Words that the command line can read as a number and that are out of the range."""
    if isinstance(of_name.low, int):
        return str(of_name.low - 1), str(of_name.high + 1)
    return "nan", "inf", "-inf", "-1", str(2.0 * of_name.high)


# The experts' settings come with the task and are no options.
OPTIONS = {
    name: f"--{name.removeprefix('settings.').replace('_', '-')}"
    for name in RANGES
    if not name.startswith("experts.settings.")
}


@functools.cache
def parsed(index):
    """One command line with word `index` of every number, because parsing takes 0.1 s."""
    pairs = [
        (option, word)
        for name, option in OPTIONS.items()
        for word in beyond(RANGES[name])[index : index + 1]
    ]
    return parse([part for pair in pairs for part in pair])


def with_number(options, name, value):
    """`options` with another number under a dotted name."""
    first, _, rest = name.partition(".")
    value = with_number(getattr(options, first), rest, value) if rest else value
    return dataclasses.replace(options, **{first: value})


@pytest.mark.parametrize(
    ("name", "index"), [(name, i) for name in OPTIONS for i in range(len(beyond(RANGES[name])))]
)
def test_a_number_out_of_range_is_refused_naming_its_option(name, index):
    option, word = OPTIONS[name], beyond(RANGES[name])[index]
    value = operator.attrgetter(name)(parsed(index))
    with pytest.raises(UserError) as error:
        validation.check(with_number(PRESETS["tuned"], name, value))
    message = str(error.value)
    assert message.startswith(f"{option}: must be ")
    number = message.rpartition(", got ")[2]
    assert str(float(number)) == str(float(word))


POOL = pools.scripted(2)
UNREWARDED = POOL.transition._replace(reward=np.zeros_like(POOL.transition.reward))
BESIDE = POOL.transition._replace(observation=POOL.transition.observation + np.float32([0, 0.1]))


@pytest.mark.parametrize(
    ("pool", "refused_by"),
    [
        (POOL, ()),
        (POOL._replace(transition=UNREWARDED), ("dynamics",)),
        (POOL._replace(transition=BESIDE), ("dynamics", "spec")),
        (POOL._replace(metadata={"env": "Other-v1"}), ("dynamics", "spec")),
        (
            POOL._replace(transition=POOL.transition._replace(action=np.zeros((999, 2)))),
            ("dynamics", "spec", "none"),
        ),
    ],
    ids=["the task's", "without rewards", "out of bounds", "of another task", "of other sizes"],
)
def test_demonstrations_are_held_to_the_task_as_far_as_check_demos_says(tmp_path, pool, refused_by):
    path = tmp_path / "pool.npz"
    size = len(pool.episode)
    action = pool.transition.action[:size]
    demonstrations.save(path, pool._replace(transition=pool.transition._replace(action=action)))
    for level in ("dynamics", "spec", "none"):
        asked = {"methods": ("bc",), "n_demos": (2,), "demos": path, "check_demos": level}
        config = dataclasses.replace(PRESETS["tuned"], **asked)
        if level in refused_by:
            with pytest.raises(UserError) as error:
                validation.plan(config)
            assert str(error.value).startswith(f"--demos: {path}: ")
            assert str(error.value).endswith("; see --check-demos")
        else:
            assert validation.plan(config).demos is not None


def test_a_task_that_does_not_keep_to_its_specification_is_refused(monkeypatch):
    env = envs.make("MountainCarContinuous-v0")
    own = env._replace(
        spec=env.spec._replace(id="Own-v0"), reset=lambda key, params: (0, np.zeros(3))
    )
    monkeypatch.setitem(envs.ENVS, "Own-v0", lambda: own)
    with pytest.raises(UserError, match=r"^--env: Own-v0: observation of reset: .*\(3,\)"):
        validation.check(dataclasses.replace(PRESETS["tuned"], env="Own-v0"))
