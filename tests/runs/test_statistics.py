import math

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.runs import statistics
from cmedirl_jax.runs.statistics import SeedCurve, SeedStatistics
from tests.support.cells import seeds_table

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


def evaluations_of(*returns):
    """Rows of evaluations.parquet, in no order, for seeds with these curves."""
    rows = [
        {
            "expert": "each",
            "method": "hs-ddpg",
            "n_demos": 10,
            "protocol": protocol,
            "seed": seed,
            "env_step": 250 * index,
            "episode": 2 * index,
            "return_mean": float(value) if protocol == "steps" else 1e6,
            "r_d_mean": 0.01 * index if index else None,
            "r_d_std": 0.02 * index if index else None,
        }
        for protocol in ("episodes", "steps")
        for seed, values in enumerate(returns)
        for index, value in enumerate(values)
    ]
    return pl.DataFrame(rows).sample(fraction=1.0, shuffle=True, seed=0)


def test_summary_of_a_cell_by_hand():
    row = statistics.summarise(
        evaluations_of([0, 92, 80], [95, 95, 95], [0, 0, 94]),
        seeds_table(3),
        90.0,
        max_episodes=None,
    )
    expected = {
        "expert": "each",
        "method": "hs-ddpg",
        "n_demos": 10,
        "seeds": 3,
        "experts": 3,
        "converged_fraction": 1.0,
        "convergence_env_step_median": 250.0,
        "total_steps_to_solve_median": 250.0 + 4_000 + 90,
        "convergence_episode_median": 2.0,
        "convergence_episode_mean": 2.0,
        "convergence_episode_std": 2.0,
        "convergence_episode_restricted": False,
        "sustained_fraction": 2 / 3,
        "dip_fraction": 0.5,
        "area": (172 + 285 + 94) / 9,
        "final_return_mean": 269 / 3,
        "final_return_std": np.std([80, 95, 94], ddof=1),
        "failed_fraction": 1 / 3,
        "best_evaluation_mean": 93.0,
        "best_evaluation_std": 2.0,
        "best_return_mean": 92.0,
        "best_return_std": 2.0,
        "best_optimism": 1.0,
        "expert_return_mean": 94.0,
        "expert_return_std": 0.0,
        "r_d_mean": 0.02,
        "r_d_std": 0.04,
        "return_after_convergence": (86 + 95 + 94) / 3,
        "iqm": 269 / 3,
        "env_steps_learner": 1_500,
        "env_steps_demonstrations": 270,
        "env_steps_expert": 12_000,
        "diverged": 0,
        "gymnasium_return_mean": 92.0,
        "gymnasium_difference_max": 0.002,
    }
    assert expected.keys() | DESIGNED_COLUMNS <= row.keys()
    assert {name: row[name] for name in expected} == pytest.approx(expected)


def test_what_never_happened_is_empty_and_every_number_in_the_summary_is_finite():
    row = statistics.summarise(
        evaluations_of([0, 0, 0], [1, 2, 3]), seeds_table(2), 90.0, max_episodes=None
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
    row = statistics.summarise(evaluations_of([0, 92]), seeds_table(1), 90.0, max_episodes=None)
    for name in ("convergence_episode_std", "final_return_std", "best_return_std"):
        assert row[name] is None, name


def test_statistics_over_episodes_are_restricted_where_episodes_bind_and_missing_where_steps_do():
    evaluations = evaluations_of([0, 92, 92], [0, 0, 0])
    seeds = seeds_table(2, episodes=[8, 8])
    by_episodes = statistics.summarise(evaluations, seeds, 90.0, max_episodes=8)
    assert by_episodes["convergence_episode_restricted"]
    assert by_episodes["convergence_episode_mean"] == pytest.approx((2 + 8) / 2)
    assert by_episodes["convergence_episode_median"] == 2.0
    # The steps ran out first.
    by_steps = statistics.summarise(evaluations, seeds, 90.0, max_episodes=9)
    assert by_steps["convergence_episode_restricted"]
    for name in ("mean", "median", "median_low", "median_high"):
        assert by_steps[f"convergence_episode_{name}"] is None


def test_where_episodes_end_the_seeds_the_area_is_over_evaluations_by_episodes():
    evaluations = evaluations_of([0, 92, 92], [0, 0, 92])
    found = statistics.summarise(evaluations, seeds_table(2), 90.0, max_episodes=8)
    assert found["area"] == 1e6
    by_steps = evaluations.filter(pl.col("protocol") == "steps")
    found = statistics.summarise(by_steps, seeds_table(2), 90.0, max_episodes=8)
    assert found["area"] == pytest.approx(276 / 6)


def test_a_seed_that_diverged_before_its_first_evaluation_by_episodes_leaves_the_others_areas():
    rows = [
        {"protocol": protocol, "seed": seed, "env_step": step, "episode": episode}
        | {"return_mean": value}
        for seed in range(3)
        for protocol, own in {
            "steps": [(0, 0, -30.0), (250, 1, 40.0)],
            "episodes": [(250, 1, 90.0), (500, 2, 95.0)],
        }.items()
        for step, episode, value in own
    ]
    gone = [{"protocol": "steps", "seed": 3, "env_step": 0, "episode": 0, "return_mean": -40.0}]
    found = statistics.of_seeds(
        pl.DataFrame(rows + gone), np.array([False] * 3 + [True]), 90.0, by_episodes=True
    )
    np.testing.assert_allclose(found.area, [92.5, 92.5, 92.5, -40.0])


def test_experts_that_seeds_share_are_paid_for_once():
    evaluations = evaluations_of([0, 92], [0, 92], [0, 92])
    seeds = seeds_table(3, expert_id=[4, 7, 4])
    row = statistics.summarise(evaluations, seeds, 90.0, max_episodes=None)
    assert row["env_steps_expert"] == 2 * 4_000
    nobody = seeds_table(3, expert_id=[None] * 3)
    row = statistics.summarise(evaluations, nobody, 90.0, max_episodes=None)
    assert row["env_steps_expert"] == 4_000


def test_a_diverged_seed_is_no_fast_one():
    """It is restricted at the run's episodes, not at those that it lived."""
    row = statistics.summarise(
        evaluations_of([0, 0, 92], [0]),
        seeds_table(2, episodes=[100, 2], diverged=[False, True]),
        90.0,
        max_episodes=100,
    )
    assert row["convergence_episode_mean"] == pytest.approx((4 + 100) / 2)


def test_a_diverged_seed_stands_at_its_lowest_return_from_then_on():
    row = statistics.summarise(
        evaluations_of([95, 95, 95, 95], [91, 95]),
        seeds_table(2, diverged=[False, True]),
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
        seeds_table(2, diverged=[False, True]),
        90.0,
        max_episodes=None,
    )
    assert row["diverged"] == 1
    assert row["seeds"] == 2
    assert row["converged_fraction"] == 0.5


def test_a_seed_that_diverged_after_it_converged_is_not_sustained():
    row = statistics.summarise(
        evaluations_of([95, 95], [95]),
        seeds_table(2, diverged=[False, True]),
        90.0,
        max_episodes=None,
    )
    assert row["converged_fraction"] == 1.0
    assert row["sustained_fraction"] == 0.5


def test_seeds_that_all_diverged_at_once_failed():
    row = statistics.summarise(
        evaluations_of([-1, 95, 95], [-1, 95, 95]),
        seeds_table(2, diverged=[True, True]),
        90.0,
        max_episodes=None,
    )
    assert row["sustained_fraction"] == 0.0
    assert row["failed_fraction"] == 1.0
    assert row["final_return_mean"] == -1.0


@pytest.mark.parametrize("dipping", [9, 10])
def test_a_rate_of_dips_has_bounds_only_where_ten_seeds_dip(dipping):
    curves = [[95, 80, 95] if seed < dipping else [95, 95, 95] for seed in range(20)]
    row = statistics.summarise(evaluations_of(*curves), seeds_table(20), 90.0, max_episodes=None)
    assert row["dip_fraction"] == pytest.approx(dipping / 40)
    assert (row["dip_fraction_low"] is None) == (dipping < 10)
    # The share of seeds that dip has an interval in any case.
    assert row["sustained_fraction"] == 1 - dipping / 20
    assert row["sustained_fraction_low"] < 1 - dipping / 20 < row["sustained_fraction_high"]


def test_experts_count_once_each_and_shared_ones_are_paid_once():
    shared = {"expert": "best", "expert_id": [3, 3], "expert_steps": [8_000, 8_000]}
    row = statistics.summarise(
        evaluations_of([0, 92], [95, 95]), seeds_table(2, **shared), 90.0, max_episodes=None
    )
    assert row["experts"] == 1
    assert row["env_steps_expert"] == 8_000


def test_seeds_without_one_expert_each_have_none():
    row = statistics.summarise(
        evaluations_of([0, 92], [95, 95]),
        seeds_table(2, expert_id=[None, None], expert_return=[None, None]),
        90.0,
        max_episodes=None,
    )
    assert row["experts"] is None
    assert row["expert_return_mean"] is None
