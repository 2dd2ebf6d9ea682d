"""From the tables of a run to one row per cell, with intervals.

Every interval is a 95% one over seeds: Clopper-Pearson for shares, order statistics for medians, a
percentile bootstrap for means. A seed that never reached the threshold counts as +infinity in a
median; it is never dropped. A seed that diverged stands at the lowest return it ever had for every
evaluation that it misses. The intervals speak of the learners' seeds alone: all of them learn from
one pool of demonstrations, made by one set of experts.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import scipy.stats

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
    """What a seed's curve comes to.

    Attributes:
        convergence_env_step: of the first evaluation at the threshold; inf if there is none.
        convergence_episode: likewise.
        sustained: it converged, and every later evaluation is at the threshold too.
        dip_fraction: share of the evaluations after the first at the threshold that fall below it;
            NaN if it never converged or nothing came after.
        area: mean return over the evaluations, each counted alike.
        final_return: of the last evaluation.
        return_after_convergence: mean return from convergence on; NaN if it never converged.
    """

    convergence_env_step: float
    convergence_episode: float
    sustained: bool
    dip_fraction: float
    area: float
    final_return: float
    return_after_convergence: float


def seed_statistics(curve: SeedCurve, threshold: float, missing: int = 0) -> SeedStatistics:
    """Reduce one seed's curve, of which the last `missing` evaluations were lost to divergence."""
    floor = np.full(missing, curve.return_mean.min())
    returns = np.concatenate([curve.return_mean, floor])
    reached = returns >= threshold
    # Once diverged, a policy that always solved the task does so no more.
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
    test = scipy.stats.quantile_test(values, q=0.0, p=0.5)
    interval = test.confidence_interval(CONFIDENCE)
    estimate = np.quantile(values, 0.5, method="lower")
    # Too few values have no order statistic on one side; scipy says NaN, which means unbounded.
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
    found = [
        seed_statistics(
            curve, threshold, missing=longest - curve.return_mean.size if diverged[seed] else 0
        )
        for seed, curve in by_seed.items()
    ]
    return SeedStatistics(*(np.array(column, float) for column in zip(*found, strict=True)))


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
            evaluation, and nothing to converge by.
    """
    diverged = seeds["diverged"].to_numpy()
    columns = of_seeds(evaluations, diverged, threshold)
    converged = np.isfinite(columns.convergence_env_step)
    first = evaluations.row(0, named=True)
    dips = columns.dip_fraction[~np.isnan(columns.dip_fraction)]
    after = columns.return_after_convergence[converged]
    best = seeds["best_return"].to_numpy()
    soft = evaluations.filter(pl.col("protocol") == "soft")["return_mean"].to_numpy()
    # Under a budget of steps a failing seed lives fewer episodes than a succeeding one: statistics
    # over episodes then say something only if no seed failed.
    lived = seeds.filter(~pl.col("diverged"))["episodes"]
    comparable = interacts and (
        bool(converged.all()) or (max_episodes is not None and bool((lived == max_episodes).all()))
    )
    restricted = np.where(converged, columns.convergence_episode, float(max_episodes or 0))
    row: dict[str, Any] = {
        **{name: first[name] for name in ("expert", "method", "n_demos")},
        "seeds": diverged.size,
        **_interval("converged_fraction", lambda: share(converged), interacts),
        **_interval(
            "convergence_env_step_median",
            lambda: _from_zero(median(columns.convergence_env_step)),
            interacts,
        ),
        **_interval(
            "convergence_episode_median",
            lambda: _from_zero(median(columns.convergence_episode)),
            comparable,
        ),
        "convergence_episode_mean": float(restricted.mean()) if comparable else None,
        "convergence_episode_std": _std(restricted) if comparable else None,
        "convergence_episode_restricted": not bool(converged.all()) if interacts else None,
        **_interval("sustained_fraction", lambda: share(columns.sustained.astype(bool)), interacts),
        **_interval("dip_fraction", lambda: mean(dips), dips.size > 0),
        **_interval("area", lambda: mean(columns.area)),
        "final_return_mean": float(columns.final_return.mean()),
        "final_return_std": _std(columns.final_return),
        "soft_return_mean": float(soft.mean()) if soft.size else None,
        "soft_return_std": _std(soft),
        "best_return_mean": float(best.mean()),
        "best_return_std": _std(best),
        **_interval("return_after_convergence", lambda: mean(after), interacts and after.size > 0),
    }
    iqm = interquartile_mean(columns.final_return)
    row |= {"iqm": iqm.estimate, "iqm_low": iqm.low, "iqm_high": iqm.high}
    row |= {
        "env_steps_learner": int(seeds["env_steps"].sum()),
        "env_steps_demonstrations": int(seeds["demonstration_steps"].sum()),
        "env_steps_expert": int(seeds["expert_steps"][0]),
        "diverged": int(diverged.sum()),
        "gymnasium_return_mean": float(seeds["gymnasium_return"].mean()),
        "gymnasium_difference_max": float(seeds["gymnasium_difference"].max()),
    }
    return row


def _from_zero(interval: Interval) -> Interval:
    """The interval of a count; its empty bounds in a table then all mean 'never'."""
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
