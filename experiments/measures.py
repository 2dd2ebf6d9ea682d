"""What cells are compared by: a number of each seed, and how large a difference matters."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from experiments.pooled import CellSeeds


class Measure(NamedTuple):
    """A number of each seed.

    Attributes:
        name: as tables call it.
        of: `(cell, the last step that a seed can reach) -> [seeds]`.
        margin: differences within it are as good as none.
        form: of a printed difference.
    """

    name: str
    of: Callable[[CellSeeds, int], np.ndarray]
    margin: float
    form: str


STEPS = Measure(
    "convergence_env_step",
    # A seed that never converged counts as converged at the last step.
    lambda cell, most: np.minimum(cell.statistics.convergence_env_step, most),
    500.0,
    "{:+,.0f}",
)
AREA = Measure("area", lambda cell, _: cell.statistics.area, 1.0, "{:+.1f}")
FINAL = Measure("final_return", lambda cell, _: cell.statistics.final_return, 1.0, "{:+.2f}")
STABLE = Measure(
    "stayed_solved",
    lambda cell, _: np.asarray(cell.statistics.sustained, float),
    0.02,
    "{:+.3f}",
)
DIPS = Measure(
    "dip_fraction",
    # A seed that never converged lies below the threshold throughout.
    lambda cell, _: np.nan_to_num(cell.statistics.dip_fraction, nan=1.0),
    0.02,
    "{:+.3f}",
)
