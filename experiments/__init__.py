"""The paper's experiment: `python -m experiments.run_grid`, and the commands beside it."""

import importlib.metadata
import re
import sys
from collections.abc import Collection

COMMANDS = (
    *("run_grid", "report", "compare", "claims"),
    *("variants", "hot_starts", "optimal_return", "portraits", "datasets"),
)


def check_command(package: str, commands: Collection[str]) -> None:
    """End `python -m PACKAGE.NAME` with a line and code 2 where it cannot work.

    That is if NAME is no command, or if what a command needs is not installed. Any other import of
    the package passes.
    """
    # Python calls the program -m while it looks for the module, whose name comes next.
    if sys.argv[:1] != ["-m"]:
        return
    parent, _, name = sys.orig_argv[-len(sys.argv)].removeprefix("-m").rpartition(".")
    if parent != package:
        return
    wrong = None
    if name not in commands:
        wrong = f"no command; the commands of {package} are {', '.join(commands)}"
    elif missing := [needed for needed in _needed() if not _is_installed(needed)]:
        there = "python -m pip install -e '.[experiments]'"
        wrong = f"{', '.join(missing)} not installed; in the project's folder, run: {there}"
    if wrong is not None:
        print(f"{name}: {wrong}", file=sys.stderr)
        sys.exit(2)


def _needed() -> list[str]:
    """This project, the packages that it requires, and those of its extra for experiments."""
    if not _is_installed("cmedirl-jax"):
        return ["cmedirl-jax"]
    requirements = importlib.metadata.requires("cmedirl-jax") or []
    return [
        re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        for requirement in requirements
        if "extra ==" not in requirement or re.search("extra == .(cli|experiments)", requirement)
    ]


def _is_installed(distribution: str) -> bool:
    try:
        importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


check_command("experiments", COMMANDS)
