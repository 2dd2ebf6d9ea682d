"""Estimates over seeds with 95% intervals.

Shares have Clopper-Pearson's interval, medians that of order statistics, means a percentile
bootstrap's. Seeds that share an expert are not independent: where `clusters` says who shares one,
experts are resampled in place of seeds.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

CONFIDENCE = 0.95
RESAMPLES = 2_000
LEAST_EVENTS = 10
"""Below as many seeds with an event, a bootstrap of its rate covers far less than it says."""

Statistic = Callable[..., Any]


class Interval(NamedTuple):
    """An estimate and its interval."""

    estimate: float
    low: float
    high: float

    def within(self, low: float, high: float) -> bool:
        """Whether the interval lies between two numbers, ends included."""
        return low <= self.low and self.high <= high


def share(successes: np.ndarray) -> Interval:
    """A share of seeds `[seeds]` bool with its Clopper-Pearson interval."""
    test = scipy.stats.binomtest(int(successes.sum()), successes.size)
    interval = test.proportion_ci(CONFIDENCE, method="exact")
    return Interval(float(successes.mean()), float(interval.low), float(interval.high))


def median(values: np.ndarray) -> Interval:
    """The lower median of `[seeds]` values, inf allowed, with its order-statistics interval."""
    test = scipy.stats.quantile_test(values, q=0, p=0.5)
    interval = test.confidence_interval(CONFIDENCE)
    estimate = np.quantile(values, 0.5, method="lower")
    # With few values scipy finds no order statistic for a bound and returns NaN: unbounded.
    low = -np.inf if np.isnan(interval.low) else interval.low
    high = np.inf if np.isnan(interval.high) else interval.high
    return Interval(float(estimate), float(low), float(high))


def mean(
    values: np.ndarray,
    statistic: Statistic = np.mean,
    *,
    clusters: np.ndarray | None = None,
    confidence: float = CONFIDENCE,
) -> Interval:
    """The mean of `[seeds]` values, or another statistic of them, with a bootstrap interval.

    Args:
        values: `[seeds]`.
        statistic: of an array along `axis`.
        clusters: `[seeds]`, which seeds share an expert; None: none do. If all share one, the
            interval speaks of that expert alone, and seeds are resampled.
        confidence: of the interval.
    """
    estimate = float(statistic(values))
    if values.size < 2 or np.ptp(values) == 0:
        return Interval(estimate, estimate, estimate)
    rng = np.random.default_rng(0)
    groups = _groups(values, clusters)
    if len(groups) in (1, values.size):
        result = scipy.stats.bootstrap(
            (values,),
            statistic,
            n_resamples=RESAMPLES,
            confidence_level=confidence,
            method="percentile",
            rng=rng,
        )
        interval = result.confidence_interval
        return Interval(estimate, float(interval.low), float(interval.high))
    drawn = rng.integers(len(groups), size=(RESAMPLES, len(groups)))
    found = _of_clusters(groups, drawn, statistic)
    tail = (1 - confidence) / 2
    low, high = np.quantile(found, [tail, 1 - tail])
    return Interval(estimate, float(low), float(high))


def _of_clusters(groups: list[np.ndarray], drawn: np.ndarray, statistic: Statistic) -> np.ndarray:
    """The statistic `[R]` of resamples that each hold the clusters `drawn` `[R, C]`."""
    values, sizes = np.concatenate(groups), np.array([len(group) for group in groups])
    starts, lengths = np.cumsum(sizes) - sizes, sizes[drawn].sum(axis=1)
    # Every resample's rows of `values`, one resample after the other.
    counts = sizes[drawn].ravel()
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    rows = np.split(np.repeat(starts[drawn].ravel(), counts) + within, np.cumsum(lengths)[:-1])
    # Resamples of one length are one array.
    found = np.empty(len(drawn))
    for length in np.unique(lengths):
        alike = np.flatnonzero(lengths == length)
        samples = values[np.stack([rows[index] for index in alike])]
        found[alike] = statistic(samples, axis=-1)
    return found


def _groups(values: np.ndarray, clusters: np.ndarray | None) -> list[np.ndarray]:
    """The values of each cluster."""
    if clusters is None:
        return [values[i : i + 1] for i in range(values.size)]
    return [values[clusters == one] for one in np.unique(clusters)]


def interquartile_mean(values: np.ndarray, *, clusters: np.ndarray | None = None) -> Interval:
    """The mean of the middle half of `[seeds]` values (Agarwal et al. 2021)."""

    def trimmed(sample: np.ndarray, axis: int = -1) -> Any:
        return scipy.stats.trim_mean(sample, 0.25, axis=axis)

    return mean(values, trimmed, clusters=clusters)


def rate(values: np.ndarray, *, clusters: np.ndarray | None = None) -> Interval:
    """The mean of `[seeds]` rates of a rare event; no bounds where few seeds have it at all.

    With fewer than `LEAST_EVENTS` of them the bounds are NaN: report the share of seeds that have
    the event instead, by `share`.
    """
    found = mean(values, clusters=clusters)
    if np.count_nonzero(values) < LEAST_EVENTS:
        return Interval(found.estimate, np.nan, np.nan)
    return found


class Survival(NamedTuple):
    """The share of seeds that have not arrived, after each time at which one does.

    Attributes:
        time: `[times]`.
        share: `[times]`, Kaplan and Meier's estimate.
        low: `[times]`, of its pointwise interval.
        high: `[times]`, likewise.
    """

    time: np.ndarray
    share: np.ndarray
    low: np.ndarray
    high: np.ndarray


def survival(times: np.ndarray) -> Survival:
    """How many seeds are left, over time.

    Args:
        times: `[seeds]`, of each seed's event; inf for a seed without one. All seeds were watched
            for as long: nobody is censored before the last event, so that the interval is Clopper
            and Pearson's.
    """
    last = times[np.isfinite(times)].max(initial=0.0)
    found = scipy.stats.ecdf(_censored(times, last)).sf
    bounds = [share(times > time) for time in found.quantiles]
    return Survival(
        found.quantiles,
        found.probabilities,
        np.array([bound.low for bound in bounds]),
        np.array([bound.high for bound in bounds]),
    )


def logrank(times: np.ndarray, reference: np.ndarray) -> float:
    """p-value of the log-rank test that two groups of seeds arrive alike.

    It takes the groups for independent and ignores that seeds are paired: a description, beside
    `runs.paired`.

    Args:
        times: `[seeds]`, as for `survival`.
        reference: `[seeds]` of the other group, watched for as long.
    """
    both = np.concatenate([times, reference])
    if np.unique(both).size == 1:
        return 1.0
    last = both[np.isfinite(both)].max()
    return float(scipy.stats.logrank(_censored(times, last), _censored(reference, last)).pvalue)


def _censored(times: np.ndarray, last: float) -> scipy.stats.CensoredData:
    """The times, with seeds without an event censored after the last event."""
    arrived = np.isfinite(times)
    return scipy.stats.CensoredData.right_censored(np.where(arrived, times, last), ~arrived)
