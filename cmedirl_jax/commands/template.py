"""Write a table with every column that demonstrations of a task may have, to be filled in.

Example: cmedirl demos template pool.csv --env Pendulum-v1
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from cmedirl_jax.commands import sources
from cmedirl_jax.data.formats import tables
from cmedirl_jax.runs.console import screen
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs


@dataclasses.dataclass(frozen=True)
class Options:
    """Which task's.

    Attributes:
        out: A file that ends in .csv or .parquet, which is not there yet.
        env: The task.
    """

    out: Annotated[Path, tyro.conf.Positional]
    env: str


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    outputs.check("out", options.out)
    if options.out.exists():
        raise UserError(f"{options.out} is there already; give another name")
    env = sources.task(options.env)
    try:
        tables.write_template(options.out, env.spec)
    except ValueError as error:
        raise UserError(str(error)) from error
    screen.say(screen.console(), f"{options.out}: an episode of two steps, to be replaced")
    return 0
