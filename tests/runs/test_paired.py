import numpy as np
import pytest
import scipy.stats

from cmedirl_jax.runs import intervals, paired
from cmedirl_jax.runs.intervals import Interval
from cmedirl_jax.runs.paired import Difference


@pytest.fixture
def few_flips(monkeypatch):
    """A test by fewer flips keeps its level, as long as they and one make whole twentieths."""
    monkeypatch.setattr(paired, "FLIPS", 999)


def rejections(draw, trials=200, level=0.05):
    """How often the test rejects at this level."""
    found = [paired.p_value(*draw(np.random.default_rng(trial))) for trial in range(trials)]
    return np.mean(np.array(found) <= level)


def test_a_difference_is_of_pairs():
    values, reference = np.array([3.0, 5.0, 9.0] * 4), np.array([1.0, 2.0, 3.0] * 4)
    found = paired.compare(values, reference)
    assert found.mean.estimate == pytest.approx(11 / 3)
    assert found.pairs == 12
    assert found.mean.low <= found.narrow.low <= found.narrow.high <= found.mean.high


def test_the_p_value_of_few_pairs_is_that_of_all_flips():
    difference = np.array([1.0, 2.0, -0.5, 3.0, 0.25, 1.5])
    signs = np.array(np.meshgrid(*[[-1, 1]] * 6)).reshape(6, -1).T
    flipped = scipy.stats.ttest_1samp(signs * difference, 0.0, axis=1).statistic
    observed = scipy.stats.ttest_1samp(difference, 0.0).statistic
    exact = np.mean(np.abs(flipped) >= abs(observed) - 1e-9)
    assert paired.p_value(difference, None) == pytest.approx(exact, abs=0.015)


def test_no_difference_at_all_is_no_evidence():
    assert paired.p_value(np.zeros(10), None) == 1.0


def test_one_pair_shows_nothing():
    found = paired.compare(np.array([5.0]), np.array([1.0]))
    assert found.p_value == 1.0
    assert paired.equivalence(found, 10.0) == paired.equivalence(found, 1.0) == "inconclusive"


@pytest.mark.parametrize("clusters", [None, np.arange(40) % 9])
def test_few_pairs_or_clusters_of_them_show_no_equivalence(clusters):
    values = np.random.default_rng(0).normal(0.0, 0.01, 9 if clusters is None else 40)
    found = paired.compare(values, np.zeros(values.size), clusters)
    assert paired.equivalence(found, 1.0) == "inconclusive"
    assert np.isfinite(found.mean).all()


def test_where_no_pair_differs_the_unseen_differences_have_an_exact_bound():
    def found(pairs, span, margin):
        same = np.zeros(pairs)
        return paired.equivalence(paired.compare(same, same, span=span), margin)

    # One-sided, at most 1 - 0.05^(1/n): 0.0295 of 100 pairs, 0.00994 of 300.
    assert found(100, 1.0, 0.02) == "inconclusive"
    assert found(300, 1.0, 0.02) == "equivalent"
    assert found(100, 12_000.0, 500.0) == "equivalent"
    assert found(100, 20_000.0, 500.0) == "inconclusive"
    assert found(100, np.inf, 500.0) == "inconclusive"


def test_a_cluster_that_differs_both_ways_differs_once():
    clusters = np.repeat(np.arange(20), 5)
    difference = np.zeros(100)
    for cluster in range(5):
        difference[5 * cluster : 5 * cluster + 2] = 0.02, -0.02
    found = paired.compare(difference, np.zeros(100), clusters, span=1.0)
    assert paired.equivalence(found, 0.02) == "inconclusive"


def test_a_large_cluster_may_be_the_one_that_differs(few_flips, monkeypatch):
    """Sixty clusters; those that differ, one in twenty, have fifty pairs, the others one."""
    # So few differ that the bound is the exact one.
    monkeypatch.setattr(intervals, "RESAMPLES", 200)

    def bounded(trial):
        differs = np.random.default_rng(trial).random(60) < 0.05
        sizes = np.where(differs, 50, 1)
        clusters = np.repeat(np.arange(60), sizes)
        difference = np.repeat(differs.astype(float), sizes)
        found = paired.compare(difference, np.zeros(difference.size), clusters, span=1.0)
        return found.narrow.high >= (0.05 * 50) / (0.05 * 50 + 0.95)

    assert np.mean([bounded(trial) for trial in range(100)]) >= 0.9


@pytest.mark.slow
def test_shares_on_the_margin_are_called_equivalent_in_at_most_a_twentieth():
    """One pair in fifty differs, all to one side."""

    def found(trial):
        differs = (np.random.default_rng(trial).random(150) < 0.02).astype(float)
        return paired.equivalence(paired.compare(differs, np.zeros(150), span=1.0), 0.02)

    assert np.mean([found(trial) == "equivalent" for trial in range(300)]) <= 0.06


def test_a_difference_in_every_pair_is_evidence():
    assert paired.p_value(np.ones(20), None) < 0.001
    assert paired.p_value(-np.linspace(1, 2, 20), None) < 0.001


def test_false_positives_are_at_the_level_for_unequal_shapes(few_flips):
    """Exponential against constant: equal means, differences far from symmetric."""

    def draw(rng):
        return rng.exponential(1.0, 100) - 1.0, None

    def flips_of_bare_means(rng):
        difference, _ = draw(rng)
        test = scipy.stats.permutation_test(
            (difference,), np.mean, permutation_type="samples", n_resamples=999, rng=rng
        )
        return test.pvalue

    assert rejections(draw) <= 0.09
    assert np.isfinite(flips_of_bare_means(np.random.default_rng(0)))


def test_false_positives_are_at_the_level_where_experts_carry_half_of_the_variance(few_flips):
    clusters = np.repeat(np.arange(16), 6)

    def draw(rng):
        return rng.normal(size=16)[clusters] + rng.normal(size=clusters.size), clusters

    assert rejections(draw) <= 0.09
    assert rejections(lambda rng: (draw(rng)[0], None)) >= 0.15


def test_real_differences_are_found(few_flips):
    assert rejections(lambda rng: (rng.normal(0.5, 1.0, 100), None)) >= 0.95


def test_one_expert_for_all_leaves_the_pairs_to_be_flipped():
    difference = np.random.default_rng(0).normal(0.3, 1.0, 40)
    assert paired.p_value(difference, np.zeros(40)) == paired.p_value(difference, None)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (-0.9, 1.0, "equivalent"),
        (-1.1, 0.0, "inconclusive"),
        (0.5, 1.5, "inconclusive"),
        (1.1, 2.0, "different"),
        (-2.0, -1.1, "different"),
    ],
)
def test_equivalence_is_an_interval_within_the_margin(low, high, expected):
    narrow = Interval((low + high) / 2, low, high)
    assert paired.equivalence(Difference(narrow, 0.5, narrow, 10), 1.0) == expected


def test_equivalence_is_claimed_falsely_in_at_most_a_twentieth(few_flips):
    """The true difference lies on the margin."""
    found = [
        paired.equivalence(
            paired.compare(np.random.default_rng(trial).normal(1.0, 1.0, 60), np.zeros(60)), 1.0
        )
        for trial in range(200)
    ]
    assert np.mean(np.array(found) == "equivalent") <= 0.09


def test_holms_p_values_are_stepwise():
    found = paired.holm(np.array([0.01, 0.04, 0.03, 0.005]))
    np.testing.assert_allclose(found, [0.03, 0.06, 0.06, 0.02])
    assert paired.holm(np.array([0.9, 0.8])).tolist() == [1.0, 1.0]


def test_holm_rejects_no_less_than_bonferroni_and_no_more_than_single_tests():
    p_values = scipy.stats.uniform.rvs(size=20, random_state=0)
    adjusted = paired.holm(p_values)
    assert ((adjusted >= p_values) & (adjusted <= np.minimum(20 * p_values, 1.0))).all()
