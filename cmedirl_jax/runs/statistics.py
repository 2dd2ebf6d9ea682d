"""A cell's statistics over its seeds, from the run's tables.

The intervals are those of `runs.intervals`. A seed that never reached the threshold counts as
+infinity in a median; it is never dropped. A diverged seed takes its lowest return in every
evaluation that it misses. Column `experts` says how many experts the seeds have: with one of their
own each, intervals hold for other experts too; with 1 they speak of that expert alone.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from cmedirl_jax.runs import intervals
from cmedirl_jax.runs.intervals import Interval

LABELS = ("study", "expert", "method", "n_demos")
"""The columns that say which cell a row belongs to."""


class SeedCurve(NamedTuple):
    """One seed's evaluations of one protocol, in order, leaves `[evaluations]`."""

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
        area: mean return over the evaluations, each counted alike; see `of_seeds`.
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


def curves(evaluations: pl.DataFrame, protocol: str = "steps") -> dict[int, SeedCurve]:
    """A cell's evaluations of a protocol, seed by seed."""
    rows = evaluations.filter(pl.col("protocol") == protocol).sort("seed", "env_step")
    return {
        int(group["seed"][0]): SeedCurve(
            group["env_step"].to_numpy(),
            group["episode"].to_numpy(),
            group["return_mean"].to_numpy(),
        )
        for group in rows.partition_by("seed", maintain_order=True)
    }


def of_seeds(
    evaluations: pl.DataFrame,
    diverged: np.ndarray,
    threshold: float,
    *,
    by_episodes: bool = False,
) -> SeedStatistics:
    """Statistics of every seed of a cell, leaves `[seeds]` float.

    Args:
        evaluations: the cell's rows of evaluations.parquet.
        diverged: `[seeds]` bool.
        threshold: the return that counts as solved.
        by_episodes: whether episodes end the seeds, at different steps. Then `area` is over the
            evaluations by episodes where there are any: by steps, a seed's failures, whose episodes
            are long, would count more than its successes.
    """
    by_steps = curves(evaluations)
    found = _of_curves(by_steps, diverged, threshold)
    over_episodes = curves(evaluations, "episodes") if by_episodes else {}
    if over_episodes:
        # A seed that diverged before its first one stands at its lowest return throughout.
        every = {seed: over_episodes.get(seed, _lowest(curve)) for seed, curve in by_steps.items()}
        found = found._replace(area=_of_curves(every, diverged, threshold).area)
    return found


def _lowest(curve: SeedCurve) -> SeedCurve:
    return SeedCurve(curve.env_step[:1], curve.episode[:1], curve.return_mean.min(keepdims=True))


def _of_curves(
    by_seed: dict[int, SeedCurve], diverged: np.ndarray, threshold: float
) -> SeedStatistics:
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
    by_episodes = max_episodes is not None
    statistics = of_seeds(evaluations, diverged, threshold, by_episodes=by_episodes)
    lived = seeds.filter(~pl.col("diverged"))["episodes"].to_numpy()
    first = evaluations.row(0, named=True)
    clusters = experts_of(seeds)
    return {
        **{name: first[name] for name in LABELS if name in first},
        "seeds": diverged.size,
        "experts": None if clusters is None else np.unique(clusters).size,
        **_convergence(statistics, lived, max_episodes, interacts),
        **_stability(statistics, threshold, interacts, clusters),
        **_returns(statistics, evaluations, interacts, clusters),
        **_best(seeds, clusters),
        **_rewards(evaluations),
        **_interval(
            "total_steps_to_solve_median",
            lambda: _from_zero(
                intervals.median(statistics.convergence_env_step + steps_before(seeds))
            ),
            interacts,
        ),
        **_costs(seeds),
    }


def experts_of(seeds: pl.DataFrame) -> np.ndarray | None:
    """`[seeds]`, the expert of each; None where they have none, or not one each."""
    if seeds["expert_id"].null_count():
        return None
    return seeds["expert_id"].to_numpy()


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
        **_interval("converged_fraction", lambda: intervals.share(converged), interacts),
        **_interval(
            "convergence_env_step_median",
            lambda: _from_zero(intervals.median(statistics.convergence_env_step)),
            interacts,
        ),
        **_interval(
            "convergence_episode_median",
            lambda: _from_zero(intervals.median(statistics.convergence_episode)),
            comparable,
        ),
        "convergence_episode_mean": float(restricted.mean()) if comparable else None,
        "convergence_episode_std": _std(restricted) if comparable else None,
        "convergence_episode_restricted": not bool(converged.all()) if interacts else None,
    }


def _stability(
    statistics: SeedStatistics, threshold: float, interacts: bool, clusters: np.ndarray | None
) -> dict[str, Any]:
    known = ~np.isnan(statistics.dip_fraction)
    dips = statistics.dip_fraction[known]
    of_known = None if clusters is None else clusters[known]
    sustained = statistics.sustained.astype(bool)
    failed = statistics.final_return < threshold
    return {
        **_interval("sustained_fraction", lambda: intervals.share(sustained), interacts),
        **_interval("failed_fraction", lambda: intervals.share(failed)),
        **_interval("dip_fraction", lambda: intervals.rate(dips, clusters=of_known), dips.size > 0),
    }


def _returns(
    statistics: SeedStatistics,
    evaluations: pl.DataFrame,
    interacts: bool,
    clusters: np.ndarray | None,
) -> dict[str, Any]:
    converged = np.isfinite(statistics.convergence_env_step)
    after = statistics.return_after_convergence[converged]
    of_converged = None if clusters is None else clusters[converged]
    soft = evaluations.filter(pl.col("protocol") == "soft")["return_mean"].to_numpy()
    middle = intervals.interquartile_mean(statistics.final_return, clusters=clusters)
    return {
        **_interval("area", lambda: intervals.mean(statistics.area, clusters=clusters)),
        "final_return_mean": float(statistics.final_return.mean()),
        "final_return_std": _std(statistics.final_return),
        "soft_return_mean": float(soft.mean()) if soft.size else None,
        "soft_return_std": _std(soft),
        **_interval(
            "return_after_convergence",
            lambda: intervals.mean(after, clusters=of_converged),
            interacts and after.size > 0,
        ),
        "iqm": middle.estimate,
        "iqm_low": middle.low,
        "iqm_high": middle.high,
    }


def _best(seeds: pl.DataFrame, clusters: np.ndarray | None) -> dict[str, Any]:
    """Columns on each seed's best policy, and on who demonstrated to it.

    `best_evaluation` is the paper's "score of the best policy": the highest of many evaluations,
    which luck raises. `best_return` scores the same policy on fresh starts; `best_optimism` is the
    difference.
    """
    evaluation, fresh, expert = (
        seeds[name].cast(pl.Float64).to_numpy()
        for name in ("best_evaluation", "best_return", "expert_return")
    )
    return {
        "best_evaluation_mean": float(evaluation.mean()),
        "best_evaluation_std": _std(evaluation),
        "best_return_mean": float(fresh.mean()),
        "best_return_std": _std(fresh),
        **_interval("best_optimism", lambda: intervals.mean(evaluation - fresh, clusters=clusters)),
        "expert_return_mean": None if np.isnan(expert).any() else float(expert.mean()),
        "expert_return_std": None if np.isnan(expert).any() else _std(expert),
    }


def _rewards(evaluations: pl.DataFrame) -> dict[str, Any]:
    """Columns on what r_D adds to r_e over the replay, at the last evaluation of each seed."""
    last = (
        evaluations.filter(pl.col("r_d_std").is_not_null())
        .sort("env_step")
        # In order: sums of floats depend on it.
        .group_by("seed", maintain_order=True)
        .agg(pl.col("r_d_mean", "r_d_std").last())
    )
    return {"r_d_mean": last["r_d_mean"].mean(), "r_d_std": last["r_d_std"].mean()}


def steps_before(seeds: pl.DataFrame) -> np.ndarray:
    """`[seeds]`, environment steps that each seed's demonstrations took, its experts' included."""
    return (
        seeds.select(pl.col("expert_steps") + pl.col("demonstration_steps")).to_series().to_numpy()
    )


def _costs(seeds: pl.DataFrame) -> dict[str, Any]:
    """Columns on what the cell took, and on how far Gymnasium agrees."""
    return seeds.select(
        env_steps_learner=pl.col("env_steps").cast(pl.Int64).sum(),
        env_steps_demonstrations=pl.col("demonstration_steps").cast(pl.Int64).sum(),
        # Once for each expert, also where several seeds share it.
        env_steps_expert=pl.col("expert_steps")
        .filter(pl.col("expert_id").is_first_distinct())
        .sum(),
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
