"""A cell's statistics over its seeds, from the run's tables.

Every interval is a 95% one over seeds: Clopper-Pearson for shares, order statistics for medians, a
percentile bootstrap for means. A seed that never reached the threshold counts as +infinity in a
median; it is never dropped. A diverged seed takes its lowest return in every evaluation that it
misses. The intervals hold for other seeds of the learners, not for other experts: all learners
share one pool of demonstrations.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import scipy.stats

LABELS = ("study", "expert", "method", "n_demos")
"""The columns that say which cell a row belongs to."""
CONFIDENCE = 0.95
RESAMPLES = 2_000


class Interval(NamedTuple):
    """An estimate and its interval."""

    estimate: float
    low: float
    high: float


class SeedCurve(NamedTuple):
    """One seed's evaluations by steps, in order, leaves `[evaluations]`."""

    env_step: np.ndarray
    episode: np.ndarray
    return_mean: np.ndarray


class SeedStatistics(NamedTuple):
    """Statistics of one seed's curve, numbers; or of many seeds, arrays `[seeds]`.

    Attributes:
        convergence_env_step: step of the first evaluation at the threshold; inf if there is none.
        convergence_episode: episodes finished by then; inf if there is none.
        sustained: it converged, and every later evaluation is at the threshold too.
        dip_fraction: share of the evaluations after the first at the threshold that fall below it;
            NaN if it never converged or nothing came after.
        area: mean return over the evaluations, each counted alike.
        final_return: return at the last evaluation.
        return_after_convergence: mean return from convergence on; NaN if it never converged.
    """

    convergence_env_step: Any
    convergence_episode: Any
    sustained: Any
    dip_fraction: Any
    area: Any
    final_return: Any
    return_after_convergence: Any


def seed_statistics(curve: SeedCurve, threshold: float, missing: int = 0) -> SeedStatistics:
    """Statistics of one seed whose last `missing` evaluations were lost to divergence."""
    floor = np.full(missing, curve.return_mean.min())
    returns = np.concatenate([curve.return_mean, floor])
    reached = returns >= threshold
    # A diverged seed no longer solves the task, whatever its lowest return was.
    reached[returns.size - missing :] = False
    area, final = float(returns.mean()), float(returns[-1])
    if not reached.any():
        return SeedStatistics(np.inf, np.inf, False, np.nan, area, final, np.nan)
    first = int(np.argmax(reached))
    after = reached[first + 1 :]
    return SeedStatistics(
        convergence_env_step=float(curve.env_step[first]),
        convergence_episode=float(curve.episode[first]),
        sustained=bool(after.all()),
        dip_fraction=float(1.0 - after.mean()) if after.size else np.nan,
        area=area,
        final_return=final,
        return_after_convergence=float(returns[first:].mean()),
    )


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


def mean(values: np.ndarray, statistic=np.mean) -> Interval:
    """The mean (or another statistic) of `[seeds]` values with a percentile bootstrap interval."""
    estimate = float(statistic(values))
    if values.size < 2 or np.ptp(values) == 0:
        return Interval(estimate, estimate, estimate)
    result = scipy.stats.bootstrap(
        (values,),
        statistic,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    interval = result.confidence_interval
    return Interval(estimate, float(interval.low), float(interval.high))


def interquartile_mean(values: np.ndarray) -> Interval:
    """The mean of the middle half of `[seeds]` values (Agarwal et al. 2021)."""

    def trimmed(sample: np.ndarray, axis: int = -1) -> Any:
        return scipy.stats.trim_mean(sample, 0.25, axis=axis)

    return mean(values, trimmed)


def curves(evaluations: pl.DataFrame) -> dict[int, SeedCurve]:
    """A cell's evaluations by steps, seed by seed."""
    rows = evaluations.filter(pl.col("protocol") == "steps").sort("seed", "env_step")
    return {
        int(group["seed"][0]): SeedCurve(
            group["env_step"].to_numpy(),
            group["episode"].to_numpy(),
            group["return_mean"].to_numpy(),
        )
        for group in rows.partition_by("seed", maintain_order=True)
    }


def of_seeds(evaluations: pl.DataFrame, diverged: np.ndarray, threshold: float) -> SeedStatistics:
    """Statistics of every seed of a cell, leaves `[seeds]` float.

    Args:
        evaluations: the cell's rows of evaluations.parquet.
        diverged: `[seeds]` bool.
        threshold: the return that counts as solved.
    """
    by_seed = curves(evaluations)
    longest = max(curve.return_mean.size for curve in by_seed.values())
    # A diverged seed misses one at least, also where all seeds of the cell diverged together.
    rows = [
        seed_statistics(
            curve,
            threshold,
            missing=max(longest - curve.return_mean.size, 1) if diverged[seed] else 0,
        )
        for seed, curve in by_seed.items()
    ]
    return SeedStatistics(*(np.array(column, float) for column in zip(*rows, strict=True)))


def summarise(
    evaluations: pl.DataFrame,
    seeds: pl.DataFrame,
    threshold: float,
    max_episodes: int | None,
    *,
    interacts: bool = True,
) -> dict[str, Any]:
    """One row of summary.csv: a cell's statistics over its seeds.

    Args:
        evaluations: the cell's rows of evaluations.parquet.
        seeds: the cell's rows of seeds.parquet.
        threshold: the return that counts as solved.
        max_episodes: of the run.
        interacts: whether the method acts in the environment; one that never does has a single
            evaluation and no convergence.
    """
    diverged = seeds["diverged"].to_numpy()
    statistics = of_seeds(evaluations, diverged, threshold)
    lived = seeds.filter(~pl.col("diverged"))["episodes"].to_numpy()
    first = evaluations.row(0, named=True)
    return {
        **{name: first[name] for name in LABELS if name in first},
        "seeds": diverged.size,
        **_convergence(statistics, lived, max_episodes, interacts),
        **_stability(statistics, interacts),
        **_returns(statistics, evaluations, seeds, interacts),
        **_costs(seeds),
    }


def _convergence(
    statistics: SeedStatistics, lived: np.ndarray, max_episodes: int | None, interacts: bool
) -> dict[str, Any]:
    """Columns on when the seeds converged; `lived`, the episodes of those that did not diverge."""
    converged = np.isfinite(statistics.convergence_env_step)
    # Under a budget of steps a failing seed lives fewer episodes than a succeeding one: statistics
    # over episodes then say something only if no seed failed.
    comparable = interacts and (
        bool(converged.all()) or (max_episodes is not None and bool((lived == max_episodes).all()))
    )
    restricted = np.where(converged, statistics.convergence_episode, float(max_episodes or 0))
    return {
        **_interval("converged_fraction", lambda: share(converged), interacts),
        **_interval(
            "convergence_env_step_median",
            lambda: _from_zero(median(statistics.convergence_env_step)),
            interacts,
        ),
        **_interval(
            "convergence_episode_median",
            lambda: _from_zero(median(statistics.convergence_episode)),
            comparable,
        ),
        "convergence_episode_mean": float(restricted.mean()) if comparable else None,
        "convergence_episode_std": _std(restricted) if comparable else None,
        "convergence_episode_restricted": not bool(converged.all()) if interacts else None,
    }


def _stability(statistics: SeedStatistics, interacts: bool) -> dict[str, Any]:
    dips = statistics.dip_fraction[~np.isnan(statistics.dip_fraction)]
    sustained = statistics.sustained.astype(bool)
    return {
        **_interval("sustained_fraction", lambda: share(sustained), interacts),
        **_interval("dip_fraction", lambda: mean(dips), dips.size > 0),
    }


def _returns(
    statistics: SeedStatistics, evaluations: pl.DataFrame, seeds: pl.DataFrame, interacts: bool
) -> dict[str, Any]:
    converged = np.isfinite(statistics.convergence_env_step)
    after = statistics.return_after_convergence[converged]
    best = seeds["best_return"].to_numpy()
    soft = evaluations.filter(pl.col("protocol") == "soft")["return_mean"].to_numpy()
    middle = interquartile_mean(statistics.final_return)
    return {
        **_interval("area", lambda: mean(statistics.area)),
        "final_return_mean": float(statistics.final_return.mean()),
        "final_return_std": _std(statistics.final_return),
        "soft_return_mean": float(soft.mean()) if soft.size else None,
        "soft_return_std": _std(soft),
        "best_return_mean": float(best.mean()),
        "best_return_std": _std(best),
        **_interval("return_after_convergence", lambda: mean(after), interacts and after.size > 0),
        "iqm": middle.estimate,
        "iqm_low": middle.low,
        "iqm_high": middle.high,
    }


def _costs(seeds: pl.DataFrame) -> dict[str, Any]:
    """Columns on what the cell took, and on how far Gymnasium agrees."""
    return seeds.select(
        env_steps_learner=pl.col("env_steps").cast(pl.Int64).sum(),
        env_steps_demonstrations=pl.col("demonstration_steps").cast(pl.Int64).sum(),
        env_steps_expert=pl.col("expert_steps").first(),
        diverged=pl.col("diverged").sum(),
        gymnasium_return_mean=pl.col("gymnasium_return").mean(),
        gymnasium_difference_max=pl.col("gymnasium_difference").max(),
    ).row(0, named=True)


def _from_zero(interval: Interval) -> Interval:
    """A count's interval: an unbounded lower bound is 0, so an empty one in a table is 'never'."""
    return interval._replace(low=max(interval.low, 0.0))


def _interval(
    name: str, of: Callable[[], Interval], there_is_one: bool = True
) -> dict[str, float | None]:
    """The three columns of an interval; empty where there is none, or a bound is infinite."""
    values = of() if there_is_one else (np.inf,) * 3
    finite = [value if np.isfinite(value) else None for value in values]
    return dict(zip((name, f"{name}_low", f"{name}_high"), finite, strict=True))


def _std(values: np.ndarray) -> float | None:
    return float(values.std(ddof=1)) if values.size > 1 else None
