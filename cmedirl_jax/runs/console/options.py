"""A command's options, read from its arguments and held to their ranges."""

import argparse
from collections.abc import Sequence
from typing import TypeVar

import tyro

from cmedirl_jax import ranges
from cmedirl_jax.runs.errors import UserError

Options = TypeVar("Options")


def read(
    kind: type[Options], command: str, description: str | None, arguments: Sequence[str] | None
) -> Options:
    """The options of `python -m COMMAND`.

    Args:
        kind: a dataclass, whose docstring explains its fields.
        command: the module's dotted name.
        description: what the command does, for its help.
        arguments: default those of the process.

    Raises:
        UserError: for a number out of its range. Mistakes that tyro finds end the process.
    """
    options = tyro.cli(kind, prog=f"python -m {command}", description=description, args=arguments)
    for name, wrong in ranges.out_of_range(options):
        raise UserError(f"--{name.replace('_', '-')}: {wrong}")
    return options


def read_first(arguments: Sequence[str], **defaults: str) -> argparse.Namespace:
    """The options that decide the defaults of others, which tyro needs before it reads any.

    Args:
        arguments: the command's.
        **defaults: of these options, also where their value is missing: tyro reports that.

    Returns:
        Their values, and as `n_demos_given` whether numbers of demonstrations are among the
        arguments: a default is no more than `--demos` holds, a number given is meant.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name, default in defaults.items():
        parser.add_argument(f"--{name}", nargs="?", default=default, const=default)
    parser.add_argument("--n-demos", "--n_demos", nargs="*")
    found = parser.parse_known_args(list(arguments))[0]
    found.n_demos_given = found.n_demos is not None
    return found
