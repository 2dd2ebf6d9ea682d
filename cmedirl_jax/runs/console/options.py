"""A command's options, read from its arguments and held to their ranges."""

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
