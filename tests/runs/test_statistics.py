import math

import numpy as np
import polars as pl
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from cmedirl_jax.runs import statistics
from cmedirl_jax.runs.statistics import SeedCurve, SeedStatistics

NEVER = math.inf
UNDEFINED = math.nan

DESIGNED_COLUMNS = {
    *("expert", "method", "n_demos", "seeds", "converged_fraction"),
    *("convergence_env_step_median", "convergence_episode_median"),
    *("convergence_episode_mean", "convergence_episode_std"),
    *("sustained_fraction", "dip_fraction", "area", "final_return_mean", "final_return_std"),
    *("best_return_mean", "best_return_std", "iqm", "iqm_low", "iqm_high"),
    *("env_steps_learner", "env_steps_demonstrations", "env_steps_expert", "diverged"),
}


def curve(returns):
    """Evaluations every 250 steps, two episodes apart."""
    index = np.arange(len(returns))
    return SeedCurve(250 * index, 2 * index, np.array(returns, float))


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        pytest.param(
            [0, 1, 2, 3],
            SeedStatistics(NEVER, NEVER, False, UNDEFINED, 1.5, 3, UNDEFINED),
            id="never",
        ),
        pytest.param(
            [95, 80, 95, 86],
            SeedStatistics(0, 0, False, 2 / 3, 89, 86, 89),
            id="at step 0, then dips",
        ),
        pytest.param(
            [0, 96, 90, 90],
            SeedStatistics(250, 2, True, 0, 69, 90, 92),
            id="sustained at exactly the threshold",
        ),
        pytest.param(
            [0, 0, 0, 96],
            SeedStatistics(750, 6, True, UNDEFINED, 24, 96, 96),
            id="only at the last evaluation",
        ),
    ],
)
def test_seed_statistics_of_hand_made_curves(returns, expected):
    np.testing.assert_allclose(statistics.seed_statistics(curve(returns), 90.0), expected)


@given(st.lists(st.integers(-5, 5), min_size=1, max_size=12))
def test_seed_statistics_match_a_loop_over_the_evaluations(returns):
    threshold = 2
    hits = [i for i, value in enumerate(returns) if value >= threshold]
    first = hits[0] if hits else None
    later = [] if first is None else returns[first + 1 :]
    below = [value for value in later if value < threshold]
    expected = SeedStatistics(
        convergence_env_step=NEVER if first is None else 250 * first,
        convergence_episode=NEVER if first is None else 2 * first,
        sustained=first is not None and not below,
        dip_fraction=len(below) / len(later) if later else UNDEFINED,
        area=sum(returns) / len(returns),
        final_return=returns[-1],
        return_after_convergence=UNDEFINED
        if first is None
        else sum(returns[first:]) / len(returns[first:]),
    )
    np.testing.assert_allclose(statistics.seed_statistics(curve(returns), threshold), expected)


@pytest.mark.parametrize("count", [1, 7, 100])
def test_share_has_the_clopper_pearson_interval(count):
    for successes in range(count + 1):
        failures = count - successes
        found = statistics.share(np.arange(count) < successes)
        low = scipy.stats.beta.ppf(0.025, successes, failures + 1) if successes else 0.0
        high = scipy.stats.beta.ppf(0.975, successes + 1, failures) if failures else 1.0
        np.testing.assert_allclose(found, (successes / count, low, high), rtol=1e-6)


@given(st.lists(st.integers(0, 20) | st.just(math.inf), min_size=1, max_size=40))
def test_median_is_the_lower_one_between_symmetric_order_statistics(values):
    ordered, count = sorted(values), len(values)
    # The 1-based rank of the lower end: P(Binomial(count, 1/2) < rank) <= 2.5%.
    cumulative = np.cumsum([math.comb(count, k) for k in range(count)]) / 2**count
    rank = int((cumulative <= 0.025).sum())
    low, high = (ordered[rank - 1], ordered[count - rank]) if rank else (-math.inf, math.inf)
    found = statistics.median(np.array(values, float))
    assert found == (ordered[(count - 1) // 2], low, high)


def test_median_of_a_minority_that_never_arrived_is_finite_and_unbounded_above():
    values = np.array([1, 2, 3, 4, 5, 6, NEVER, NEVER, NEVER])
    assert statistics.median(values) == (5, 2, NEVER)


def test_bootstrap_interval_covers_a_normal_mean_at_the_nominal_rate():
    samples = np.random.default_rng(7).normal(3.0, 2.0, (300, 60))
    intervals = [statistics.mean(sample) for sample in samples]
    covered = np.mean([interval.low <= 3.0 <= interval.high for interval in intervals])
    # Two standard errors of 300 trials about 94%, a percentile bootstrap's rate at this size.
    assert 0.913 <= covered <= 0.967
    np.testing.assert_allclose([interval.estimate for interval in intervals], samples.mean(axis=1))


@pytest.mark.parametrize("values", [[2.5], [2.5, 2.5, 2.5]])
def test_mean_of_equal_values_has_an_interval_of_no_width(values):
    assert statistics.mean(np.array(values)) == (2.5, 2.5, 2.5)


@given(st.lists(st.integers(-100, 100), min_size=1, max_size=15))
@settings(max_examples=40)
def test_interquartile_mean_drops_a_quarter_of_the_sorted_values_at_each_end(values):
    cut = len(values) // 4
    middle = sorted(values)[cut : len(values) - cut]
    found = statistics.interquartile_mean(np.array(values, float))
    assert found.estimate == pytest.approx(sum(middle) / len(middle))
    assert min(values) <= found.low <= found.high <= max(values)


def evaluations_of(*returns):
    """Rows of evaluations.parquet, in no order, for seeds with these curves."""
    rows = [
        {
            "expert": "best",
            "method": "hs-ddpg",
            "n_demos": 10,
            "protocol": protocol,
            "seed": seed,
            "env_step": 250 * index,
            "episode": 2 * index,
            "return_mean": float(value) if protocol == "steps" else 1e6,
        }
        for protocol in ("episodes", "steps")
        for seed, values in enumerate(returns)
        for index, value in enumerate(values)
    ]
    return pl.DataFrame(rows).sample(fraction=1.0, shuffle=True, seed=0)


def seeds_of(count, **columns):
    """Rows of seeds.parquet."""
    return pl.DataFrame(
        {
            "seed": range(count),
            "env_steps": [500] * count,
            "episodes": [7 + seed for seed in range(count)],
            "demonstration_steps": [90] * count,
            "expert_steps": [4_000] * count,
            "diverged": [False] * count,
            "best_return": [90.0 + 2.0 * seed for seed in range(count)],
            "gymnasium_return": [91.0 + seed for seed in range(count)],
            "gymnasium_difference": [0.001 * seed for seed in range(count)],
            **columns,
        }
    )


def test_summary_of_a_cell_by_hand():
    row = statistics.summarise(
        evaluations_of([0, 92, 80], [95, 95, 95], [0, 0, 94]),
        seeds_of(3),
        90.0,
        max_episodes=None,
    )
    expected = {
        "expert": "best",
        "method": "hs-ddpg",
        "n_demos": 10,
        "seeds": 3,
        "converged_fraction": 1.0,
        "convergence_env_step_median": 250.0,
        "convergence_episode_median": 2.0,
        "convergence_episode_mean": 2.0,
        "convergence_episode_std": 2.0,
        "convergence_episode_restricted": False,
        "sustained_fraction": 2 / 3,
        "dip_fraction": 0.5,
        "area": (172 + 285 + 94) / 9,
        "final_return_mean": 269 / 3,
        "final_return_std": np.std([80, 95, 94], ddof=1),
        "best_return_mean": 92.0,
        "best_return_std": 2.0,
        "return_after_convergence": (86 + 95 + 94) / 3,
        "iqm": 269 / 3,
        "env_steps_learner": 1_500,
        "env_steps_demonstrations": 270,
        "env_steps_expert": 4_000,
        "diverged": 0,
        "gymnasium_return_mean": 92.0,
        "gymnasium_difference_max": 0.002,
    }
    assert expected.keys() | DESIGNED_COLUMNS <= row.keys()
    assert {name: row[name] for name in expected} == pytest.approx(expected)


def test_what_never_happened_is_empty_and_every_number_in_the_summary_is_finite():
    row = statistics.summarise(
        evaluations_of([0, 0, 0], [1, 2, 3]), seeds_of(2), 90.0, max_episodes=None
    )
    for name in (
        "convergence_env_step_median",
        "convergence_episode_median",
        "convergence_episode_mean",
        "dip_fraction",
        "return_after_convergence",
    ):
        assert row[name] is None, name
    assert row["converged_fraction"] == row["sustained_fraction"] == 0.0
    assert all(math.isfinite(value) for value in row.values() if isinstance(value, float))


def test_one_seed_has_no_standard_deviation():
    row = statistics.summarise(evaluations_of([0, 92]), seeds_of(1), 90.0, max_episodes=None)
    for name in ("convergence_episode_std", "final_return_std", "best_return_std"):
        assert row[name] is None, name


def test_statistics_over_episodes_are_restricted_where_episodes_bind_and_missing_where_steps_do():
    evaluations = evaluations_of([0, 92, 92], [0, 0, 0])
    seeds = seeds_of(2, episodes=[8, 8])
    by_episodes = statistics.summarise(evaluations, seeds, 90.0, max_episodes=8)
    assert by_episodes["convergence_episode_restricted"]
    assert by_episodes["convergence_episode_mean"] == pytest.approx((2 + 8) / 2)
    assert by_episodes["convergence_episode_median"] == 2.0
    # The steps ran out first.
    by_steps = statistics.summarise(evaluations, seeds, 90.0, max_episodes=9)
    assert by_steps["convergence_episode_restricted"]
    for name in ("mean", "median", "median_low", "median_high"):
        assert by_steps[f"convergence_episode_{name}"] is None


def test_a_diverged_seed_is_no_fast_one():
    """It is restricted at the run's episodes, not at those that it lived."""
    row = statistics.summarise(
        evaluations_of([0, 0, 92], [0]),
        seeds_of(2, episodes=[100, 2], diverged=[False, True]),
        90.0,
        max_episodes=100,
    )
    assert row["convergence_episode_mean"] == pytest.approx((4 + 100) / 2)


def test_a_diverged_seed_stands_at_its_lowest_return_from_then_on():
    row = statistics.summarise(
        evaluations_of([95, 95, 95, 95], [91, 95]),
        seeds_of(2, diverged=[False, True]),
        90.0,
        max_episodes=None,
    )
    assert row["final_return_mean"] == pytest.approx((95 + 91) / 2)
    assert row["area"] == pytest.approx((95 + (91 + 95 + 91 + 91) / 4) / 2)
    # Of three evaluations after the first it misses two.
    assert row["dip_fraction"] == pytest.approx(2 / 3 / 2)


def test_diverged_seeds_are_counted_and_kept():
    row = statistics.summarise(
        evaluations_of([0, 92, 92], [0]),
        seeds_of(2, diverged=[False, True]),
        90.0,
        max_episodes=None,
    )
    assert row["diverged"] == 1
    assert row["seeds"] == 2
    assert row["converged_fraction"] == 0.5


def test_a_seed_that_diverged_after_it_converged_is_not_sustained():
    row = statistics.summarise(
        evaluations_of([95, 95], [95]),
        seeds_of(2, diverged=[False, True]),
        90.0,
        max_episodes=None,
    )
    assert row["converged_fraction"] == 1.0
    assert row["sustained_fraction"] == 0.5
