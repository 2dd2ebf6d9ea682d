"""Read demonstrations of any format and write them in another.

Example: cmedirl demos convert D4RL/pointmaze/open-v2 pool.npz --env PointMaze_Open-v3
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from cmedirl_jax.commands import sources
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.formats.base import Format
from cmedirl_jax.data.formats.reading import Actions
from cmedirl_jax.runs.console import screen
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs
from cmedirl_jax.types import EnvSpec


@dataclasses.dataclass(frozen=True)
class Options:
    """What to convert.

    Attributes:
        source: A file or folder of any format (docs/data.md), or the id of a dataset of Minari's.
        target: A file that ends in .npz, .csv or .parquet, or the id of a new dataset of Minari's.
        env: Their task: they are held to it, and what is missing is computed where it can be.
        format: The source's format, where it does not look like what it is.
        actions: What happens to actions out of bounds.
    """

    source: Annotated[str, tyro.conf.Positional]
    target: Annotated[str, tyro.conf.Positional]
    env: str
    format: str | None = None
    actions: Actions = "refuse"


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    check_target(options.target)
    env = sources.task(options.env)
    try:
        pool = demonstrations.read(options.source, options.format, env=env, actions=options.actions)
    except (FileNotFoundError, ModuleNotFoundError, ValueError) as error:
        raise UserError(" ".join(str(error).split())) from error
    write(options.target, pool, env.spec)
    screen.say(
        screen.console(),
        f"{options.target}: {int(pool.episode[-1]) + 1} episodes, {len(pool.episode)} steps",
    )
    return 0


def check_target(target: str) -> None:
    """Refuse a target that no format is written to.

    Raises:
        UserError: naming what there is.
    """
    _format_of(target)
    if Path(target).suffix:
        outputs.check("target", Path(target))


def write(target: str, pool: demonstrations.Demonstrations, spec: EnvSpec) -> None:
    """Write a pool in the format that the target's name says.

    Raises:
        UserError: if what writes it is not installed, or refuses it.
        OSError: if a file cannot be written.
    """
    chosen = _format_of(target)
    assert chosen.write is not None
    try:
        chosen.write(target, pool, spec)
    except (ModuleNotFoundError, ValueError) as error:
        raise UserError(f"{target}: {' '.join(str(error).split())}") from error


def _format_of(target: str) -> Format:
    for each in demonstrations.FORMATS.values():
        if each.writes is not None and each.writes(target):
            return each
    raise UserError(f"{target}: it ends in none of .npz, .csv, .parquet, nor in -vN as an id")
