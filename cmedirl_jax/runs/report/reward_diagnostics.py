"""What is known of a reward without the true one, and which of it tells how a learner performs."""

import numpy as np
import polars as pl
import scipy.stats
from polars.dataframe.group_by import GroupBy

from cmedirl_jax.runs.report.reward_samples import LEARNER

LAST_SHARE = 0.25
"""Share of the evaluations by steps whose mean says how a learner performs at the end."""
LEAST = 4
"""Learners that a correlation needs."""
EVERY = "all"
"""The name of the rows over all methods."""
DIAGNOSTICS = {
    "gap": "r_D of demonstrations less that of the learner's background, at the end of its "
    "learning: what is left of Algorithm 1's objective",
    "effective_sample_size": "of the background's weights, likewise",
    "discrepancy": "maximum mean discrepancy of demonstrations and policy",
    "wasserstein": "their sliced Wasserstein distance",
    "auc": "how often a demonstrated step is paid more than one of the policy",
    "disagreement": "mean distance to the rewards of the other seeds (0.71: unrelated)",
}
"""What is measured, in words."""


def of_learners(cards: pl.DataFrame, evaluations: pl.DataFrame) -> pl.DataFrame:
    """A row for each learner: its diagnostics at the end of training, and its return.

    Args:
        cards: a row for each reward, with the diagnostics that are not of the training.
        evaluations: the run's table.
    """
    by_steps = evaluations.filter(pl.col("protocol") == "steps")
    # A reward may stop learning long before its agent.
    learning = _last(by_steps.filter(pl.col("demonstration_reward").is_not_null()))
    of_reward = learning.agg(
        (pl.col("demonstration_reward") - pl.col("background_reward")).mean().alias("gap"),
        pl.col("effective_sample_size").mean(),
    )
    of_agent = _last(by_steps).agg(pl.col("return_mean").mean().alias("return"))
    joined = cards.join(of_reward, on=LEARNER, how="left").join(of_agent, on=LEARNER, how="left")
    there = [name for name in DIAGNOSTICS if name in joined.columns]
    return joined.select(*LEARNER, *there, "return")


def _last(evaluations: pl.DataFrame) -> GroupBy:
    """The last quarter of each learner's own evaluations, or its only one, by learner."""
    order = pl.col("env_step").rank("dense").over(LEARNER)
    share = order / pl.col("env_step").n_unique().over(LEARNER)
    return evaluations.filter(share > 1.0 - LAST_SHARE).group_by(LEARNER, maintain_order=True)


def correlations(learners: pl.DataFrame) -> pl.DataFrame:
    """Spearman's rank correlation of each diagnostic with the return, for each method and for all.

    The 95% interval is Bonett and Wright's (2000), which takes learners for independent. Over all
    methods, learners are ranked among those of their own method and number of demonstrations:
    otherwise it would be a correlation of methods.

    Args:
        learners: as `of_learners` gives them.
    """
    pooled: dict[str, list[np.ndarray]] = {}
    found = []
    for (method, n_demos), rows in learners.group_by("method", "n_demos", maintain_order=True):
        for name in (name for name in DIAGNOSTICS if name in rows.columns):
            pairs = rows.select(name, "return").drop_nulls().to_numpy()
            if len(pairs) < LEAST or (np.ptp(pairs, axis=0) == 0).any():
                continue
            ranks = scipy.stats.rankdata(pairs, axis=0) / (len(pairs) + 1)
            pooled.setdefault(name, []).append(ranks)
            row = {"method": method, "n_demos": n_demos, "diagnostic": name}
            found.append(row | {"mean": float(pairs[:, 0].mean())} | _correlation(ranks))
    for name, ranks in pooled.items():
        found.append({"method": EVERY, "diagnostic": name} | _correlation(np.concatenate(ranks)))
    return pl.DataFrame(found, schema=_CORRELATIONS)


def _correlation(ranks: np.ndarray) -> dict[str, float]:
    """Spearman's coefficient of ranks `[learners, 2]` with its interval."""
    rho = float(np.corrcoef(ranks.T)[0, 1])
    error = np.sqrt((1.0 + rho**2 / 2.0) / (len(ranks) - 3))
    # Of a correlation of 1 the interval is one point.
    with np.errstate(divide="ignore"):
        low, high = np.tanh(np.arctanh(np.clip(rho, -1.0, 1.0)) + error * _NORMAL)
    interval = {"low": float(low), "high": float(high)}
    return {"learners": len(ranks), "rank_correlation": rho} | interval


_CORRELATIONS = {
    "method": pl.String,
    "n_demos": pl.Int64,
    "diagnostic": pl.String,
    "learners": pl.Int64,
    "mean": pl.Float64,
    "rank_correlation": pl.Float64,
    "low": pl.Float64,
    "high": pl.Float64,
}
_NORMAL = np.array(scipy.stats.norm.interval(0.95))
