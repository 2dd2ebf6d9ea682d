"""What cells are compared by: a number of each seed, and how large a difference matters."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cmedirl_jax.runs import paired
from experiments import pooled
from experiments.pooled import CellSeeds, Pooled


class Measure(NamedTuple):
    """A number of each seed.

    Attributes:
        name: as tables call it.
        of: `(cell, its runs) -> [seeds]`.
        margin: differences within it are as good as none.
        form: of a printed difference.
        span: `runs -> ` the largest difference that there can be.
    """

    name: str
    of: Callable[[CellSeeds, Pooled], np.ndarray]
    margin: float
    form: str
    span: Callable[[Pooled], float] = lambda runs: np.inf


STEPS = Measure(
    "convergence_env_step",
    # A seed that never converged counts as converged at the last step.
    lambda cell, runs: np.minimum(cell.statistics.convergence_env_step, runs.steps),
    500.0,
    "{:+,.0f}",
    lambda runs: float(runs.steps),
)
EPISODES = Measure(
    "convergence_episode",
    lambda cell, runs: np.minimum(cell.statistics.convergence_episode, runs.episodes or np.inf),
    5.0,
    "{:+.1f}",
    lambda runs: float(runs.episodes or np.inf),
)
AREA = Measure("area", lambda cell, _: cell.statistics.area, 1.0, "{:+.1f}")
FINAL = Measure("final_return", lambda cell, _: cell.statistics.final_return, 1.0, "{:+.2f}")
STABLE = Measure(
    "stayed_solved",
    lambda cell, _: np.asarray(cell.statistics.sustained, float),
    0.02,
    "{:+.3f}",
    lambda _: 1.0,
)


def _dips(cell: CellSeeds, _: Pooled) -> np.ndarray:
    found = cell.statistics
    # A seed that never converged lies below the threshold throughout; one that did so at its last
    # evaluation has not dipped.
    without = np.where(np.isfinite(found.convergence_env_step), 0.0, 1.0)
    return np.where(np.isnan(found.dip_fraction), without, found.dip_fraction)


DIPS = Measure("dip_fraction", _dips, 0.02, "{:+.3f}", lambda _: 1.0)


def difference(
    measure: Measure, cell: tuple[CellSeeds, Pooled], reference: tuple[CellSeeds, Pooled]
) -> dict[str, Any]:
    """Columns on a cell against another, seed by seed.

    Args:
        measure: by what.
        cell: with its runs.
        reference: with its own, which may be other ones.
    """
    (mine, runs), (others, base) = cell, reference
    here, there = pooled.aligned(mine, others)
    found = paired.compare(
        measure.of(mine, runs)[here],
        measure.of(others, base)[there],
        pooled.clusters(mine, others, here, there),
        span=measure.span(runs),
    )
    return {
        "seeds": found.pairs,
        "difference": found.mean.estimate,
        "difference_low": found.mean.low,
        "difference_high": found.mean.high,
        "p_value": found.p_value,
        "equivalence": paired.equivalence(found, measure.margin),
    }


def speed(runs: Pooled) -> Measure:
    """When the seeds converge, in the unit in which all of them live as long."""
    return STEPS if runs.episodes is None else EPISODES
