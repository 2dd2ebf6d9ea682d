"""Say what is in demonstrations: episodes, lengths, returns, coverage, and what fails validation.

Example: cmedirl demos inspect pool.csv --env Pendulum-v1 --picture pool.png
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich import box
from rich.table import Table

from cmedirl_jax.commands import sources
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs import drawing
from cmedirl_jax.runs.console import screen
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs

PARTS = (0, 25, 50, 75, 100)
"""The percentiles that the table shows."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to look at.

    Attributes:
        source: A file or folder of any format (docs/data.md), or the id of a dataset of Minari's.
        env: Their task: the demonstrations are held to it.
        format: Their format, where they do not look like what they are.
        picture: A PNG or SVG file for a picture of lengths, returns, observations and actions.
    """

    source: Annotated[str, tyro.conf.Positional]
    env: str | None = None
    format: str | None = None
    picture: Path | None = None


def run(options: Options) -> int:
    """Run the command; the exit code is 1 if the demonstrations are not the task's."""
    outputs.check("picture", options.picture)
    if options.picture is not None and options.picture.suffix not in (".png", ".svg"):
        raise UserError(f"--picture: {options.picture} ends neither in .png nor in .svg")
    env = None if options.env is None else sources.task(options.env)
    pool = sources.pool(options.source, options.format, env)
    console, wrong = screen.console(), _wrong(pool, env)

    # What there is.
    length = demonstrations.episodes(pool).length
    ends = int(np.sum(pool.transition.terminated)), int(np.sum(pool.truncated))
    screen.say(
        console,
        f"{len(length)} episodes, {len(pool.episode)} steps; the task ended {ends[0]}, a time "
        f"limit or whoever recorded them {ends[1]}",
    )
    for name in demonstrations.absent(pool):
        screen.say(console, f"There are no {name}s")
    for name, value in pool.metadata.items():
        screen.say(console, f"{name}: {_short(value)}")
    screen.show(console, _table(pool, env))

    # What is wrong with it.
    if env is not None:
        screen.say(console, wrong or _right(pool, env))
    if options.picture is not None:
        drawing.save(
            lambda: _figure(pool, env),
            [options.picture],
            lambda line: screen.say(console, line),
        )
    return 0 if wrong is None else 1


def _wrong(pool: Demonstrations, env: Env | HostEnv | None) -> str | None:
    """What is not the task's, in a line."""
    if env is None:
        return None
    try:
        demonstrations.check(pool, env)
    except ValueError as error:
        return str(error)
    return None


def _right(pool: Demonstrations, env: Env | HostEnv) -> str:
    """What was found right."""
    if demonstrations.can_be_repeated(pool, env):
        return f"Every step is one of {env.spec.id}"
    return (
        f"Bounds and the order of steps are those of {env.spec.id}; successors and rewards were "
        "not compared: the task cannot be set to an observation, or there are no actions"
    )


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 80 else f"{text[:76]} ..."


def _columns(pool: Demonstrations, env: Env | HostEnv | None) -> list[tuple[str, np.ndarray, str]]:
    """Name, values and bounds of all that is counted."""
    lacking = demonstrations.absent(pool)
    columns = [("length", np.asarray(demonstrations.episodes(pool).length), "")]
    if "reward" not in lacking:
        columns.append(("return", demonstrations.returns(pool), ""))
    for name in ("observation", "action"):
        values = np.asarray(getattr(pool.transition, name))
        for index in range(0 if name in lacking else values.shape[1]):
            bounds = ""
            if env is not None:
                low, high = (getattr(env.spec, f"{name}_{end}")[index] for end in ("low", "high"))
                bounds = f"{low:.4g} to {high:.4g}"
            columns.append((f"{name}[{index}]", values[:, index], bounds))
    return columns


def _table(pool: Demonstrations, env: Env | HostEnv | None) -> Table:
    table = Table(box=box.SIMPLE)
    table.add_column("")
    for part in PARTS:
        table.add_column({0: "least", 50: "median", 100: "most"}.get(part, f"{part}%"))
    table.add_column("bounds")
    for name, values, bounds in _columns(pool, env):
        numbers = [f"{number:.4g}" for number in np.percentile(values, PARTS)]
        table.add_row(name.replace("[", "\\["), *numbers, bounds)
    return table


def _figure(pool: Demonstrations, env: Env | HostEnv | None) -> drawing.Figure:
    """A histogram of each column."""
    columns = _columns(pool, env)
    rows = -(-len(columns) // 3)
    figure = drawing.Figure(figsize=(9, 2.4 * rows), layout="constrained")
    axes = list(figure.subplots(rows, 3, squeeze=False).flat)
    for place, (name, values, _) in zip(axes, columns, strict=False):
        # A constant would be drawn on an axis of roundings.
        spread = (values.min(), values.max()) if np.ptp(values) else (values[0] - 1, values[0] + 1)
        of_episodes = name in ("length", "return")
        # Most steps look alike where a policy holds still: the others are seen on a log scale.
        place.hist(values, bins=40, range=spread, log=not of_episodes)
        place.set_xlabel(name)
        place.set_ylabel("episodes" if of_episodes else "steps")
    for place in axes[len(columns) :]:
        place.set_visible(False)
    return figure
