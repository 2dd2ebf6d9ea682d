"""Differences of samples against scipy and against slow references."""

import jax
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.assess import occupancy

KEY = jax.random.key(0)
seeds = st.integers(0, 1_000)
discrepancy = jax.jit(occupancy.maximum_mean_discrepancy)
distance = jax.jit(lambda ours, theirs: occupancy.sliced_wasserstein(KEY, ours, theirs))
on_a_line = jax.jit(lambda ours, theirs: occupancy.sliced_wasserstein(KEY, ours, theirs, 4))
area = jax.jit(occupancy.area_under_roc)


def samples(seed, n, m, shift=0.0):
    rng = np.random.default_rng(seed)
    ours, theirs = rng.normal(size=(n, 3)), rng.normal(size=(m, 3)) + shift
    return ours.astype(np.float32), theirs.astype(np.float32)


def slow_discrepancy(ours, theirs):
    pooled = [np.asarray(x, np.float64) for x in (*ours, *theirs)]
    squares = [[np.sum((x - y) ** 2) for y in pooled] for x in pooled]
    median = np.median([squares[i][j] for j in range(len(pooled)) for i in range(j)])
    n = len(ours)

    def mean(rows, columns):
        return np.mean(
            [np.exp(-squares[i][j] / (2 * median)) for i in rows for j in columns if i != j]
        )

    first, second = range(n), range(n, len(pooled))
    return np.sqrt(max(0, mean(first, first) + mean(second, second) - 2 * mean(first, second)))


@given(seed=seeds, shift=st.floats(0.0, 3.0))
def test_the_discrepancy_is_that_of_its_definition(seed, shift):
    ours, theirs = samples(seed, 9, 6, shift)
    squared = float(discrepancy(ours, theirs)) ** 2
    assert squared == pytest.approx(slow_discrepancy(ours, theirs) ** 2, abs=1e-5)


def test_discrepancies_tell_samples_apart_and_not_a_sample_from_itself():
    for measure in (discrepancy, distance):
        near, far = (float(measure(*samples(0, 400, 300, shift))) for shift in (0.0, 1.0))
        assert near < 0.2 * far


@given(seed=seeds, shift=st.floats(0.0, 3.0))
def test_on_a_line_the_sliced_distance_is_wassersteins(seed, shift):
    ours, theirs = samples(seed, 12, 7, shift)
    found = on_a_line(ours[:, :1], theirs[:, :1])
    expected = scipy.stats.wasserstein_distance(ours[:, 0], theirs[:, 0])
    assert found == pytest.approx(expected, abs=1e-5)


@given(seed=seeds)
def test_the_area_under_the_curve_is_that_of_all_pairs(seed):
    rng = np.random.default_rng(seed)
    # Few different scores: many ties.
    positive, negative = rng.integers(0, 6, 15) / 2.0, rng.integers(0, 6, 20) / 2.0
    pairs = np.sign(positive[:, None] - negative[None])
    found = area(positive.astype(np.float32), negative.astype(np.float32))
    assert found == pytest.approx(np.mean((pairs + 1) / 2), abs=1e-6)


def test_the_effective_share_counts_equal_weights():
    assert occupancy.effective_share(np.zeros(7, np.float32)) == pytest.approx(1.0)
    one = np.array([0.0, -100.0, -100.0, -100.0], np.float32)
    assert occupancy.effective_share(one) == pytest.approx(0.25)
