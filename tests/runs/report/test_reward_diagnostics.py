"""What tells how a learner performs, without the true reward."""

import numpy as np
import polars as pl
import pytest

from cmedirl_jax.runs.report import reward_diagnostics

LABELS = {"method": "me-ddpg", "n_demos": 5}


def evaluations(returns, gaps):
    """Evaluations of four steps each; the first three say nothing of the end."""
    rows = []
    for seed, (last, gap) in enumerate(zip(returns, gaps, strict=True)):
        for step in range(4):
            at_end = step == 3
            learned = {"demonstration_reward": gap, "background_reward": 0.0}
            row = {"protocol": "steps", "seed": seed, "env_step": 10 * step}
            row |= {"return_mean": last if at_end else -99.0, "effective_sample_size": 3.0}
            rows.append(LABELS | row | {k: v if at_end else 7.0 for k, v in learned.items()})
    return pl.DataFrame(rows)


def test_a_diagnostic_is_ranked_with_the_return_at_the_end():
    returns, gaps = [10.0, 90.0, 50.0, 70.0, 30.0], [5.0, 1.0, 3.0, 2.5, 2.0]
    cards = pl.DataFrame({"seed": range(5), "auc": [0.5, 0.9, 0.7, 0.8, 0.6]})
    cards = cards.select(pl.lit("me-ddpg").alias("method"), pl.lit(5).alias("n_demos"), pl.all())
    learners = reward_diagnostics.of_learners(cards, evaluations(returns, gaps))
    assert learners["return"].to_list() == returns
    assert learners["gap"].to_list() == gaps
    found = reward_diagnostics.correlations(learners)
    # The effective sample size does not vary, and tells nothing.
    assert found.select("method", "diagnostic").rows() == [
        (method, name) for method in ("me-ddpg", "all") for name in ("gap", "auc")
    ]
    assert found["rank_correlation"].to_list() == pytest.approx([-0.7, 1.0] * 2)
    assert (found["low"] <= found["rank_correlation"]).all()
    assert (found["rank_correlation"] <= found["high"]).all()


def test_over_all_methods_learners_are_ranked_among_their_own():
    rows = [
        {"method": method, "n_demos": 5, "auc": base + i / 10, "return": base * 90 + sign * i}
        for method, base, sign in (("gail", 0.0, 1), ("me-ddpg", 1.0, -1))
        for i in range(6)
    ]
    found = reward_diagnostics.correlations(pl.DataFrame(rows))
    correlation = dict(found.select("method", "rank_correlation").rows())
    # Pooled as they are they would correlate by 0.5.
    assert correlation == pytest.approx({"gail": 1.0, "me-ddpg": -1.0, "all": 0.0})


def test_the_interval_covers_the_correlation_of_normal_pairs():
    rng, covered = np.random.default_rng(0), 0
    # Spearman's coefficient of normal pairs, by Pearson's of 0.5.
    true = 6.0 / np.pi * np.arcsin(0.25)
    for _ in range(300):
        x, noise = rng.normal(size=(2, 60))
        rows = pl.DataFrame({"auc": x, "return": 0.5 * x + np.sqrt(0.75) * noise})
        rows = rows.with_columns(method=pl.lit("gail"), n_demos=pl.lit(5))
        low, high = reward_diagnostics.correlations(rows).select("low", "high").row(0)
        covered += low <= true <= high
    assert 0.91 <= covered / 300 <= 0.99


def test_a_learner_that_ended_early_is_judged_by_its_own_evaluations():
    table = evaluations([10.0, 20.0, 30.0, 40.0], [1.0, 2.0, 3.0, 4.0])
    early = pl.col("seed") == 0
    table = table.with_columns(
        env_step=pl.when(early).then(pl.col("env_step") // 10).otherwise(pl.col("env_step"))
    )
    cards = table.select("method", "n_demos", "seed").unique(maintain_order=True)
    found = reward_diagnostics.of_learners(cards, table)
    assert found["return"].to_list() == [10.0, 20.0, 30.0, 40.0]
    # A method without steps has one evaluation.
    table = table.filter(pl.col("env_step") == 0)
    assert reward_diagnostics.of_learners(cards, table)["return"].to_list() == [-99.0] * 4
