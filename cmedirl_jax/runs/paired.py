"""Comparisons of two cells seed by seed.

Seed i of every method draws the same networks, starts and noise, and has the same expert. So
differences are taken within pairs. The null of `p_value` is that their mean is 0. Its statistic is
studentised, since sign flips of the bare mean reject too often where the two laws have unequal
shapes. "No effect" is shown by `equivalence`, never by a large p-value; for that, ten pairs are too
few, and so are ten that differ at all, unless a bound on the differences makes up for them.
"""

from typing import Literal, NamedTuple

import numpy as np
import scipy.stats

from cmedirl_jax.runs import intervals
from cmedirl_jax.runs.intervals import Interval

FLIPS = 9_999
EQUIVALENCE_CONFIDENCE = 0.9
"""Of the interval that has to lie within the margins: two one-sided tests at 5%."""
LEAST_PAIRS = 10
"""Fewer pairs, or clusters of them, show no equivalence: their bootstrap covers far too little."""

Equivalence = Literal["equivalent", "different", "inconclusive"]


class Difference(NamedTuple):
    """Of paired values.

    Attributes:
        mean: of the differences, with its 95% interval.
        p_value: see `p_value`.
        narrow: the mean with its 90% interval, for `equivalence`; unbounded for few pairs.
        pairs: how many.
    """

    mean: Interval
    p_value: float
    narrow: Interval
    pairs: int


def compare(
    values: np.ndarray,
    reference: np.ndarray,
    clusters: np.ndarray | None = None,
    *,
    span: float = np.inf,
) -> Difference:
    """Compare `[pairs]` values with the reference's.

    Args:
        values: finite.
        reference: of the same seeds.
        clusters: `[pairs]`, which pairs share an expert; None: none do.
        span: no pair can differ by more.
    """
    difference = values - reference
    return Difference(
        intervals.mean(difference, clusters=clusters),
        p_value(difference, clusters),
        _narrow(difference, clusters, span),
        difference.size,
    )


def _narrow(difference: np.ndarray, clusters: np.ndarray | None, span: float) -> Interval:
    """The mean with an interval whose two ends hold at 95% each, also where few pairs differ."""
    found = intervals.mean(difference, clusters=clusters, confidence=EQUIVALENCE_CONFIDENCE)
    units = np.arange(difference.size) if clusters is None else clusters
    if np.unique(units).size == 1:
        units = np.arange(difference.size)
    _, sizes = np.unique(units, return_counts=True)
    if sizes.size < LEAST_PAIRS:
        return Interval(found.estimate, -np.inf, np.inf)
    if np.unique(units[difference != 0]).size >= intervals.LEAST_EVENTS:
        return found
    # A bootstrap knows nothing of differences that it did not see. The mean is at most the span
    # times the probability of a difference on that side, which has an exact bound; a large cluster
    # may be one that differs.
    largest = span * sizes.max() / sizes.mean()
    low, high = (
        largest
        * scipy.stats.binomtest(np.unique(units[side]).size, sizes.size)
        .proportion_ci(EQUIVALENCE_CONFIDENCE)
        .high
        for side in (difference < 0, difference > 0)
    )
    return Interval(found.estimate, -low, high)


def p_value(difference: np.ndarray, clusters: np.ndarray | None) -> float:
    """Two-sided p-value of "the mean difference is 0", by flipping signs of studentised means.

    Pairs that share an expert are flipped together. With one cluster for all pairs, each is flipped
    by itself, and the test speaks of that expert alone.
    """
    sums = difference
    if clusters is not None and np.unique(clusters).size > 1:
        _, index = np.unique(clusters, return_inverse=True)
        sums = np.bincount(index, weights=difference)
    if sums.size < 2 or not sums.any():
        return 1.0
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(FLIPS, sums.size))
    flipped = np.abs(_studentised(signs * sums))
    # Rounding must not tell equal statistics apart.
    extreme = flipped >= np.abs(_studentised(sums)) * (1 - 1e-12)
    return float((1 + extreme.sum()) / (1 + FLIPS))


def _studentised(sums: np.ndarray) -> np.ndarray:
    """`[..., n]` -> `[...]`: the mean over its standard error, inf where all are equal."""
    mean, deviation = sums.mean(axis=-1), sums.std(axis=-1, ddof=1)
    with np.errstate(divide="ignore"):
        return np.sqrt(sums.shape[-1]) * mean / deviation


def equivalence(difference: Difference, margin: float) -> Equivalence:
    """Whether the mean difference is within `margin` of 0, beyond it, or neither is shown."""
    narrow = difference.narrow
    if narrow.within(-margin, margin):
        return "equivalent"
    if narrow.low > margin or narrow.high < -margin:
        return "different"
    return "inconclusive"


def holm(p_values: np.ndarray) -> np.ndarray:
    """Holm's (1979) adjusted p-values, `[tests]`."""
    order = np.argsort(p_values)
    scaled = p_values[order] * np.arange(p_values.size, 0, -1)
    adjusted = np.empty_like(p_values)
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return adjusted
