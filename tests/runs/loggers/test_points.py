import numpy as np

from cmedirl_jax.runs import intervals
from cmedirl_jax.runs.loggers import points
from tests.support import logs

RETURNS = (1.0, 2.0, 6.0)


def of(rows, first_seed=0, experts=None, each_seed=False):
    return points.of(rows, range(first_seed, first_seed + 3), experts, each_seed=each_seed)


def test_means_have_the_interval_over_seeds():
    (mean,) = of(logs.evaluation(50, RETURNS)).values()
    assert mean.step == 50
    found = [mean.scalars[f"return_mean{end}"] for end in ("", "_low", "_high")]
    assert found == list(intervals.mean(np.array(RETURNS)))
    assert found[1] < 3.0 < found[2]


def test_seeds_that_share_an_expert_are_resampled_together():
    experts = np.array([4, 4, 7])
    mean = of(logs.evaluation(50, RETURNS), experts=experts)["mean"].scalars
    expected = intervals.mean(np.array(RETURNS), clusters=experts)
    assert (mean["return_mean_low"], mean["return_mean_high"]) == expected[1:]


def test_one_seed_has_no_interval():
    found = points.of(logs.evaluation(50, [2.0]), range(1), None, each_seed=False)
    assert set(found["mean"].scalars) == {
        *("return_mean", "return_std", "goal_fraction", "length_mean")
    }


def test_each_seed_is_a_series_by_its_number_in_the_study():
    found = of(logs.evaluation(50, RETURNS, q_mean=4.0), first_seed=8, each_seed=True)
    assert list(found) == ["mean", "seed-8", "seed-9", "seed-10"]
    assert found["seed-10"].scalars["return_mean"] == 6.0
    assert found["seed-10"].scalars["q_mean"] == 4.0


def test_what_is_unknown_is_left_out():
    rows = logs.evaluation(50, RETURNS)
    q_mean = np.array([1.0, np.nan, np.inf])
    found = of(rows._replace(means=rows.means._replace(q_mean=q_mean)), each_seed=True)
    assert [name for name, point in found.items() if "q_mean" in point.scalars] == ["seed-0"]
    every = [value for point in found.values() for value in point.scalars.values()]
    assert np.isfinite(every).all()


def test_the_spread_of_r_d_stands_in_place_of_its_mean_square():
    rows = logs.evaluation(50, RETURNS)
    means = rows.means._replace(r_d_mean=np.full(3, 3.0), r_d_mean_square=np.full(3, 13.0))
    scalars = of(rows._replace(means=means))["mean"].scalars
    assert (scalars["r_d_mean"], scalars["r_d_std"]) == (3.0, 2.0)
    assert "r_d_mean_square" not in scalars


def test_means_end_where_the_first_seed_does():
    left = logs.evaluation(50, RETURNS[:2], seeds=[0, 2])
    assert list(of(left, each_seed=True)) == ["seed-0", "seed-2"]
    # Seed 1 was out of episodes at step 44.
    ended = logs.evaluation(50, RETURNS, steps=[50, 44, 50])
    found = of(ended, each_seed=True)
    assert {name: point.step for name, point in found.items()} == {
        "seed-0": 50,
        "seed-1": 44,
        "seed-2": 50,
    }


def test_only_evaluations_by_steps_are_logged():
    for protocol in ("episodes", "soft"):
        assert of(logs.evaluation(50, RETURNS, protocol=protocol), each_seed=True) == {}
