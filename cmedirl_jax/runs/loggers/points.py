"""From a cell's evaluations to the points of its series."""

import numpy as np

from cmedirl_jax.runs import intervals
from cmedirl_jax.runs.cells.record import EvaluationRows
from cmedirl_jax.runs.loggers.base import Point
from cmedirl_jax.runs.storage import tables

MEAN = "mean"
"""The series of the means over a cell's seeds."""


def of(
    rows: EvaluationRows, seeds: range, experts: np.ndarray | None, *, each_seed: bool
) -> dict[str, Point]:
    """The points that an evaluation adds, by the name of their series.

    The means end where the first seed of the cell does, be it out of episodes or diverged: means
    over the seeds that are left would be means over others. So do the curves of the figures.

    Args:
        rows: the evaluation; one that is not by steps has no points.
        seeds: the numbers of the cell's seeds in the study.
        experts: `[seeds]`, which share an expert, as in `intervals.mean`.
        each_seed: whether each seed is a series too, `seed-NUMBER`.
    """
    if rows.protocol != "steps":
        return {}
    scalars = {**rows.evaluation._asdict(), **tables.means(rows.means)}
    columns = {name: np.asarray(values, np.float64) for name, values in scalars.items()}
    points = {}
    if len(rows.seed) == len(seeds) and np.ptp(rows.env_step) == 0:
        points[MEAN] = Point(int(rows.env_step[0]), _means(columns, experts))
    if each_seed:
        for place, index in enumerate(rows.seed):
            own = {name: float(x[place]) for name, x in columns.items() if np.isfinite(x[place])}
            points[f"seed-{seeds[index]}"] = Point(int(rows.env_step[place]), own)
    return points


def _means(columns: dict[str, np.ndarray], experts: np.ndarray | None) -> dict[str, float]:
    """Means over `[seeds]` values with their intervals; of one seed there is no interval."""
    scalars: dict[str, float] = {}
    for name, values in columns.items():
        # NaN means 'no update yet', or that the method learns no such thing.
        if not np.isfinite(values).all():
            continue
        found = intervals.mean(values, clusters=experts)
        scalars[name] = found.estimate
        if values.size > 1:
            scalars |= {f"{name}_low": found.low, f"{name}_high": found.high}
    return scalars
