"""Modules that are started by `python -m`."""

import importlib.metadata
import sys

import pytest

import benchmarks
import experiments
from tests.support import ROOT

VERSION = importlib.metadata.version


@pytest.fixture
def start(monkeypatch, capsys):
    """What Python does before `python -m MODULE ARGUMENTS`; returns what was printed."""

    def check(package, module, *arguments):
        monkeypatch.setattr(sys, "argv", ["-m", *arguments])
        monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", "-m", module, *arguments])
        experiments.check_command(package.__name__, package.COMMANDS)

    def refused(*words):
        with pytest.raises(SystemExit) as end:
            check(*words)
        assert end.value.code == 2
        return capsys.readouterr().err

    check.refused = refused
    return check


@pytest.mark.parametrize("package", [experiments, benchmarks])
def test_a_module_is_a_command_or_says_which_are(start, package):
    for path in (ROOT / package.__name__).glob("[!_]*.py"):
        module = f"{package.__name__}.{path.stem}"
        if 'if __name__ == "__main__":' in path.read_text():
            start(package, module, "--out", "-m")
        else:
            line = start.refused(package, module, "--help")
            there = ", ".join(package.COMMANDS)
            assert line == (
                f"{path.stem}: no command; the commands of {package.__name__} are {there}\n"
            )


@pytest.mark.parametrize("absent", [("cmedirl-jax",), ("jax",), ("tyro", "polars")])
def test_a_command_that_is_not_installed_gives_the_command_that_installs_it(
    start, monkeypatch, absent
):
    def version(name):
        if name in absent:
            raise importlib.metadata.PackageNotFoundError(name)
        return VERSION(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    line = start.refused(experiments, "experiments.run_grid")
    assert line.count("\n") == 1
    assert all(name in line for name in absent)
    assert line.endswith(
        " not installed; in the project's folder, run: python -m pip install -e '.[experiments]'\n"
    )
    # Other programs may import the package, and other packages' modules may be started.
    start(experiments, "benchmarks.peer_loops.sb3_ddpg")
    monkeypatch.setattr(sys, "argv", ["pytest"])
    experiments.check_command("experiments", ())
