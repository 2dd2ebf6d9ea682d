import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from cmedirl_jax.runs import intervals

NEVER = math.inf


@pytest.mark.parametrize("count", [1, 7, 100])
def test_share_has_the_clopper_pearson_interval(count):
    for successes in range(count + 1):
        failures = count - successes
        found = intervals.share(np.arange(count) < successes)
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
    found = intervals.median(np.array(values, float))
    assert found == (ordered[(count - 1) // 2], low, high)


def test_median_of_a_minority_that_never_arrived_is_finite_and_unbounded_above():
    values = np.array([1, 2, 3, 4, 5, 6, NEVER, NEVER, NEVER])
    assert intervals.median(values) == (5, 2, NEVER)


def test_bootstrap_interval_covers_a_normal_mean_at_the_nominal_rate():
    samples = np.random.default_rng(7).normal(3.0, 2.0, (300, 60))
    found = [intervals.mean(sample) for sample in samples]
    covered = np.mean([one.low <= 3.0 <= one.high for one in found])
    # Two standard errors of 300 trials about 94%, a percentile bootstrap's rate at this size.
    assert 0.913 <= covered <= 0.967
    np.testing.assert_allclose([one.estimate for one in found], samples.mean(axis=1))


@pytest.mark.parametrize("values", [[2.5], [2.5, 2.5, 2.5]])
def test_mean_of_equal_values_has_an_interval_of_no_width(values):
    assert intervals.mean(np.array(values)) == (2.5, 2.5, 2.5)


@given(st.lists(st.integers(-100, 100), min_size=1, max_size=15))
@settings(max_examples=40)
def test_interquartile_mean_drops_a_quarter_of_the_sorted_values_at_each_end(values):
    cut = len(values) // 4
    middle = sorted(values)[cut : len(values) - cut]
    found = intervals.interquartile_mean(np.array(values, float))
    assert found.estimate == pytest.approx(sum(middle) / len(middle))
    assert min(values) <= found.low <= found.high <= max(values)


def test_a_rate_of_few_events_has_no_bounds():
    few, enough = np.zeros(50), np.zeros(50)
    few[:9], enough[:10] = 0.1, 0.1
    estimate, *bounds = intervals.rate(few)
    assert estimate == pytest.approx(0.018)
    assert np.isnan(bounds).all()
    assert np.isfinite(intervals.rate(enough)).all()


def covered(draw, interval, truth, trials=250):
    """How often an interval of a sample holds the truth."""
    found = [interval(*draw(np.random.default_rng(trial))) for trial in range(trials)]
    return np.mean([one.low <= truth <= one.high for one in found])


def test_seeds_that_share_an_expert_are_resampled_with_it():
    """16 experts that carry half of the variance, 6 seeds each."""
    clusters = np.repeat(np.arange(16), 6)

    def draw(rng):
        return (rng.normal(size=16)[clusters] + rng.normal(size=clusters.size),)

    honest = covered(draw, lambda x: intervals.mean(x, clusters=clusters), 0.0)
    blind = covered(draw, intervals.mean, 0.0)
    # A bootstrap of 16 clusters covers about 0.92 itself.
    assert honest >= 0.87
    assert blind <= 0.75


def test_seeds_of_one_expert_are_resampled_themselves():
    values = np.random.default_rng(0).normal(size=30)
    assert intervals.mean(values, clusters=np.zeros(30)) == intervals.mean(values)
    assert intervals.mean(values, clusters=np.arange(30)) == intervals.mean(values)


def test_clopper_pearson_covers_rare_events_where_a_bootstrap_of_their_rate_does_not():
    def draw(rng):
        return (rng.random(32) < 0.03,)

    assert covered(draw, intervals.share, 0.03) >= 0.95
    assert covered(lambda rng: (draw(rng)[0].astype(float),), intervals.mean, 0.03) <= 0.75


def test_survival_without_censoring_is_the_share_left():
    times = np.array([0.0, 250.0, 250.0, 500.0])
    at, left, low, high = intervals.survival(times)
    np.testing.assert_array_equal(at, [0.0, 250.0, 500.0])
    np.testing.assert_allclose(left, [0.75, 0.25, 0.0], atol=1e-12)
    assert ((low <= left) & (left <= high)).all()


def test_survival_with_censoring_is_the_product_of_the_steps():
    times = np.array([1.0, 2.0, 2.0, 5.0, NEVER, NEVER])
    at, left, low, high = intervals.survival(times)
    expected, share, remaining = [], 1.0, times.size
    for time in (1.0, 2.0, 5.0):
        events = int((times == time).sum())
        share *= 1 - events / remaining
        remaining -= events
        expected.append(share)
    np.testing.assert_allclose(left[np.isin(at, [1.0, 2.0, 5.0])], expected)
    assert (low < high).all()


def test_survival_covers_a_known_share():
    def draw(rng):
        # Each further time would be an interval more to compute.
        return (np.minimum(np.ceil(rng.exponential(3.0, 60)), 5.0),)

    def at_three(times):
        at, left, low, high = intervals.survival(times)
        index = np.searchsorted(at, 3.0, side="right") - 1
        return intervals.Interval(left[index], low[index], high[index])

    assert covered(draw, at_three, math.exp(-1.0)) >= 0.92


def test_where_nobody_arrives_everybody_is_left():
    found = intervals.survival(np.full(5, NEVER))
    np.testing.assert_array_equal([found.share[-1], found.high[-1]], [1.0, 1.0])
    assert 0.4 < found.low[-1] < 0.6


def test_the_log_rank_test_is_scipys_with_both_groups_watched_as_long():
    rng = np.random.default_rng(0)
    times, reference = np.ceil(rng.exponential(3.0, 40)), np.full(40, NEVER)
    reference[:5] = 9.0
    ends = scipy.stats.CensoredData.right_censored(
        np.r_[np.full(5, 9.0), np.full(35, 99.0)], reference == NEVER
    )
    expected = scipy.stats.logrank(scipy.stats.CensoredData(times), ends).pvalue
    assert intervals.logrank(times, reference) == pytest.approx(expected)
    assert intervals.logrank(times, np.full(40, NEVER)) < 1e-6


@pytest.mark.parametrize("time", [0.0, 5.0, NEVER])
def test_groups_that_all_arrive_at_once_or_never_are_alike(time):
    assert intervals.logrank(np.full(6, time), np.full(4, time)) == 1.0


def test_the_log_rank_test_rejects_equal_laws_at_its_level():
    def p_value(trial):
        return intervals.logrank(*np.ceil(np.random.default_rng(trial).exponential(3.0, (2, 50))))

    assert np.mean([p_value(trial) <= 0.05 for trial in range(300)]) <= 0.08


@given(data=st.data())
def test_resampled_clusters_are_those_that_were_drawn(data):
    sizes = data.draw(st.lists(st.integers(1, 4), min_size=2, max_size=5))
    groups = [np.arange(size) + 10.0 * index for index, size in enumerate(sizes)]
    one = st.integers(0, len(sizes) - 1)
    drawn = np.array(data.draw(st.lists(st.tuples(*[one] * len(sizes)), min_size=1, max_size=6)))
    for statistic in (np.mean, np.max):
        expected = [statistic(np.concatenate([groups[i] for i in row])) for row in drawn]
        found = intervals._of_clusters(groups, drawn, statistic)
        np.testing.assert_allclose(found, expected, rtol=1e-12)
