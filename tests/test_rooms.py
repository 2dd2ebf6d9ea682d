"""The rooms of the library, and what each may import."""

import ast
import subprocess
import sys

import pytest

from tests.support import ROOT

LIBRARY = ROOT / "cmedirl_jax"
TOP = (
    *("types", "checks", "ranges", "rounding", "registries"),
    *("networks", "normalisation", "observation_statistics"),
    *("products", "hyperparameters", "optimizers", "grids", "modes", "compilation"),
)
ROOMS = (
    *("io", "envs", "data", "agents", "irl", "tabular", "training", "assess"),
    *("runs", "commands"),
)
ORDER = dict.fromkeys(TOP, 0) | {name: place + 1 for place, name in enumerate(ROOMS)}
# What only the command line and the experiments need.
CLI = ("PIL", "filelock", "matplotlib", "platformdirs", "polars", "rich", "scipy", "tyro")
SOURCES = sorted(LIBRARY.rglob("*.py"))


def imported(path):
    """Dotted names of all that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(path):
    parts = path.relative_to(LIBRARY).with_suffix("").parts
    return parts[0]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(LIBRARY)))
def test_a_room_imports_only_rooms_above_it(path):
    if path == LIBRARY / "__init__.py":
        return
    for name in imported(path):
        first, _, rest = name.partition(".")
        assert first not in ("experiments", "benchmarks", "tests")
        if first == "cmedirl_jax":
            assert ORDER[rest.split(".")[0]] <= ORDER[room(path)]
        # Formats import what reads them when they are read, as the next test shows.
        if first in CLI and path.parent.name != "formats":
            assert room(path) in ("runs", "commands")


def test_every_room_has_its_place():
    assert {room(path) for path in SOURCES} == {*ORDER, "__init__"}


def test_no_test_file_imports_another():
    for path in (ROOT / "tests").rglob("*.py"):
        for name in imported(path):
            first, *rest = name.split(".")
            assert first != "tests" or not any(part.startswith("test_") for part in rest)


def test_the_library_needs_nothing_of_the_command_line():
    # jax and flax bring scipy and rich.
    absent = sorted({*CLI} - {"rich", "scipy"})
    script = (
        "import sys\n"
        f"for name in {absent!r}: sys.modules[name] = None\n"
        "import cmedirl_jax as cm\n"
        "assert cm.envs.make('MountainCarContinuous-v0').spec.action_dim == 1\n"
    )
    subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=True)
