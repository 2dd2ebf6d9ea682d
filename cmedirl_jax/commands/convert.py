"""Read demonstrations of any format and write them in another.

Example: cmedirl demos convert D4RL/pointmaze/open-v2 pool.npz --env PointMaze_Open-v3
Example: cmedirl demos convert pool.csv good.csv --env Pendulum-v1 --min-return -200
"""

import dataclasses
import warnings
from pathlib import Path
from typing import Annotated

import tyro

from cmedirl_jax.commands import sources
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.formats.base import Format
from cmedirl_jax.data.formats.reading import Actions
from cmedirl_jax.ranges import FINITE
from cmedirl_jax.runs.console import screen, streams
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
        min_return: Keep only the episodes that return at least this much.
    """

    source: Annotated[str, tyro.conf.Positional]
    target: Annotated[str, tyro.conf.Positional]
    env: str
    format: str | None = None
    actions: Actions = "refuse"
    min_return: Annotated[float, FINITE] | None = None


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    check_target(options.target)
    env = sources.task(options.env)
    try:
        pool = demonstrations.read(options.source, options.format, env=env, actions=options.actions)
    except (FileNotFoundError, ModuleNotFoundError, ValueError) as error:
        raise UserError(" ".join(str(error).split())) from error
    if options.min_return is not None:
        pool = _good(pool, options.min_return)
    write(options.target, pool, env.spec)
    screen.say(
        screen.console(),
        f"{options.target}: {int(pool.episode[-1]) + 1} episodes, {len(pool.episode)} steps",
    )
    return 0


def _good(pool: demonstrations.Demonstrations, least: float) -> demonstrations.Demonstrations:
    """The episodes that return at least so much."""
    if "reward" in demonstrations.absent(pool):
        raise UserError("--min-return: the demonstrations have no rewards")
    returns = demonstrations.returns(pool)
    if returns.max() < least:
        raise UserError(
            f"--min-return: the best of {len(returns)} episodes returns {returns.max():.4g}"
        )
    return demonstrations.keep(pool, returns >= least)


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
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        try:
            chosen.write(target, pool, spec)
        except (ModuleNotFoundError, ValueError) as error:
            raise UserError(f"{target}: {' '.join(str(error).split())}") from error
        finally:
            for warning in noted:
                streams.complain(f"{target}: {warning.message}")


def _format_of(target: str) -> Format:
    for each in demonstrations.FORMATS.values():
        if each.writes is not None and each.writes(target):
            return each
    raise UserError(f"{target}: it ends in none of .npz, .csv, .parquet, nor in -vN as an id")
