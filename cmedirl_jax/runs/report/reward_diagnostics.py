"""What is known of a reward without the true one, and which of it tells how a learner performs."""

import numpy as np
import polars as pl
import scipy.stats

LAST_SHARE = 0.25
"""Share of the evaluations by steps whose mean says how a learner performs at the end."""
EVERY = "all"
"""The name of the rows over all methods."""
DIAGNOSTICS = {
    "gap": "r_D of demonstrations less that of the learner's background: what is left of Algorithm "
    "1's gradient",
    "effective_sample_size": "of the background's weights",
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
    shared = ["method", "n_demos", "seed"]
    # The last quarter of each learner's own evaluations; the only one of a method without steps.
    order = pl.col("env_step").rank("dense").over(shared)
    share = order / pl.col("env_step").n_unique().over(shared)
    of_training = (
        evaluations.filter(pl.col("protocol") == "steps")
        .filter(share > 1.0 - LAST_SHARE)
        .with_columns(gap=pl.col("demonstration_reward") - pl.col("background_reward"))
        .group_by(shared, maintain_order=True)
        .agg(
            pl.col("gap", "effective_sample_size").mean(),
            pl.col("return_mean").mean().alias("return"),
        )
    )
    joined = cards.join(of_training, on=shared, how="left")
    there = [name for name in DIAGNOSTICS if name in joined.columns]
    return joined.select(*shared, *there, "return")


def correlations(learners: pl.DataFrame) -> pl.DataFrame:
    """Spearman's rank correlation of each diagnostic with the return, for each method and for all.

    The 95% interval is Bonett and Wright's (2000), which takes learners for independent. Over all
    methods a correlation is mostly one of differences between methods.

    Args:
        learners: as `of_learners` gives them.
    """
    groups = [(EVERY, None, learners)]
    groups += [
        (str(method), n_demos, rows)
        for (method, n_demos), rows in learners.group_by("method", "n_demos", maintain_order=True)
    ]
    found = []
    for method, n_demos, rows in groups:
        for name in DIAGNOSTICS:
            if name not in rows.columns:
                continue
            pairs = rows.select(name, "return").drop_nulls().to_numpy()
            if len(pairs) < 4 or (np.ptp(pairs, axis=0) == 0).any():
                continue
            # Spearman's coefficient is Pearson's of the ranks.
            rho = float(np.corrcoef(scipy.stats.rankdata(pairs, axis=0).T)[0, 1])
            error = np.sqrt((1.0 + rho**2 / 2.0) / (len(pairs) - 3))
            # Of a correlation of 1 the interval is one point.
            with np.errstate(divide="ignore"):
                low, high = np.tanh(np.arctanh(np.clip(rho, -1.0, 1.0)) + error * _NORMAL)
            found.append(
                {
                    "method": method,
                    "n_demos": n_demos,
                    "diagnostic": name,
                    "learners": len(pairs),
                    "mean": float(pairs[:, 0].mean()),
                    "rank_correlation": rho,
                    "low": float(low),
                    "high": float(high),
                }
            )
    return pl.DataFrame(found, schema=_CORRELATIONS)


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
