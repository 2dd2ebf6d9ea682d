"""When numbers count as in bounds, or as equal, in spite of rounding. On the host."""

import numpy as np

ROUNDINGS = 100.0
"""Roundings by which two numbers may differ and still count as equal. Steps of Gymnasium's own
MountainCarContinuous-v0 differ from ours by less than 1."""


def outside(vectors: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which numbers of `[..., D]` leave their bounds by more than rounding, or are not finite.

    Bounds may be infinite.
    """
    bounds = np.array([low, high], np.float64)
    slack = 1e-6 * np.minimum(bounds[1] - bounds[0], np.maximum(1.0, np.abs(bounds)))
    inside = (vectors >= bounds[0] - slack[0]) & (vectors <= bounds[1] + slack[1])
    return ~(inside & np.isfinite(vectors))


def tolerance(values: np.ndarray) -> np.ndarray:
    """How far each number of `[N, D]` may differ: `ROUNDINGS` roundings of float32.

    A rounding counts the number itself and the mean size of its column: what is left of a
    difference has the rounding of what was subtracted. It counts a hundredth more, since a column
    of zeros may be such a difference throughout, as is the sine of pi.
    """
    size = np.abs(values.astype(np.float64))
    return ROUNDINGS * float(np.finfo(np.float32).eps) * (size + size.mean(axis=0) + 0.01)
