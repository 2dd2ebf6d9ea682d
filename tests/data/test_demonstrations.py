import chex
import jax
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.data import demonstrations
from cmedirl_jax.types import DemonstrationSubset
from tests.support import pools

KEY = jax.random.key(0)
EPISODES = demonstrations.episodes(pools.random_pool([3, 1, 4, 2, 6, 5, 1, 2]))
subset_of_eight = jax.jit(
    lambda key, n, size: demonstrations.subset(key, EPISODES, n, size), static_argnums=2
)


@given(lengths=pools.episode_lengths)
def test_episodes_are_where_the_pool_has_them(lengths):
    start, length = demonstrations.episodes(pools.random_pool(lengths))
    np.testing.assert_array_equal(start, np.cumsum([0, *lengths[:-1]]))
    np.testing.assert_array_equal(length, lengths)


@given(n=st.integers(1, 8), padding=st.integers(0, 7), seed=st.integers(0, 2**32 - 1))
def test_a_subset_is_n_different_episodes_and_padding(n, padding, seed):
    key, size = jax.random.key(seed), min(n + padding, 8)
    padded = jax.device_get(subset_of_eight(key, n, size))
    assert padded.start.shape == padded.length.shape == (size,)
    assert len(set(padded.start[:n])) == n
    pairs = set(zip(*EPISODES, strict=True))
    assert set(zip(*(field[:n] for field in padded), strict=True)) <= pairs
    assert not padded.length[n:].any()
    for field, unpadded in zip(padded, subset_of_eight(key, n, n), strict=True):
        np.testing.assert_array_equal(field[:n], unpadded)


def test_subsets_are_drawn_uniformly():
    subsets = jax.vmap(subset_of_eight, in_axes=(0, None, None))(jax.random.split(KEY, 4000), 2, 2)
    pairs = np.unique(np.asarray(subsets.start), axis=0, return_counts=True)[1]
    assert len(pairs) == 8 * 7
    assert scipy.stats.chisquare(pairs).pvalue > 1e-3


def test_the_number_of_demonstrations_can_be_traced():
    counts = np.array([1, 3, 5])
    subsets = jax.jit(jax.vmap(lambda n: demonstrations.subset(KEY, EPISODES, n, 5)))(counts)
    for n, start, length in zip(counts, *subsets, strict=True):
        expected = demonstrations.subset(KEY, EPISODES, int(n), 5)
        np.testing.assert_array_equal(start, expected.start)
        np.testing.assert_array_equal(length, expected.length)


@pytest.mark.parametrize(
    ("n", "size", "message"),
    [
        (0, None, "got 0"),
        (-1, 4, "between 1 and 4, got -1"),
        (5, 4, "between 1 and 4, got 5"),
        (np.int64(0), None, "got 0"),
        (9, None, "9 demonstrations asked, the pool holds 8"),
        (2, 9, "9 demonstrations asked, the pool holds 8"),
    ],
)
def test_impossible_subsets_are_refused(n, size, message):
    with pytest.raises(ValueError, match=message):
        demonstrations.subset(KEY, EPISODES, n, size)


@pytest.mark.parametrize(("n", "size"), [(2.5, None), (2.5, 3), (np.float32(2), 3), (2, 2.5)])
def test_numbers_of_demonstrations_are_whole(n, size):
    with pytest.raises(TypeError, match=r"expected .*integer"):
        demonstrations.subset(KEY, EPISODES, n, size)


def test_one_number_of_demonstrations_is_drawn_at_a_time():
    with pytest.raises(ValueError, match=r"n: expected shape \(\), got \(3,\)"):
        demonstrations.subset(KEY, EPISODES, np.array([1, 2, 3]), 3)


# Steps 4..7 and 10..15 of the pool of eight, with padding between and after.
SUBSET = DemonstrationSubset(np.array([4, 8, 10, 0]), np.array([4, 0, 6, 0]))


def test_sampling_is_uniform_over_the_steps_of_a_subset():
    index = jax.jit(lambda key: demonstrations.sample_index(key, SUBSET, 10_000))(KEY)
    steps, counts = np.unique(index, return_counts=True)
    np.testing.assert_array_equal(steps, [4, 5, 6, 7, 10, 11, 12, 13, 14, 15])
    assert scipy.stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"length": np.array([4])}, ValueError, r"length: expected shape \(4,\), got \(1,\)"),
        ({"start": np.array(4)}, ValueError, r"start: expected shape \(1,\), got \(\)"),
        ({"start": np.zeros(4)}, TypeError, "start: expected integers, got float32"),
    ],
)
def test_subsets_that_contradict_themselves_are_refused(change, error, message):
    subset = SUBSET._replace(**change)
    with pytest.raises(error, match=rf"subset\.{message}"):
        demonstrations.sample_index(KEY, subset, 3)
    with pytest.raises(error, match=rf"subset\.{message}"):
        demonstrations.sample_episodes(KEY, subset, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": np.array([4, 8, -1, 0])}, r"start must be at least 0, got -1 at \[2\]"),
        ({"length": np.array([4, 0, -6, 0])}, r"length must be at least 0, got -6 at \[2\]"),
        ({"length": np.zeros(4, int)}, "length: expected a positive one"),
    ],
)
def test_subsets_of_no_steps_are_refused(change, message):
    subset = SUBSET._replace(**change)
    for draw in (demonstrations.sample_index, demonstrations.sample_episodes):
        with pytest.raises(ValueError, match=rf"subset\.{message}"):
            draw(KEY, subset, 3)


def test_steps_beyond_a_pool_are_refused():
    pool = pools.random_pool([3, 4]).transition
    with pytest.raises(ValueError, match="an episode ends at step 8, the pool has 7 steps"):
        demonstrations.sample(KEY, pool, DemonstrationSubset(np.array([3]), np.array([5])), 2)
    for index in (-1, 7):
        with pytest.raises(ValueError, match=f"index must be .* below 7, got {index}"):
            demonstrations.at(pool, np.array(index))


def test_negative_sample_sizes_are_refused():
    with pytest.raises(ValueError, match="batch_size must be at least 0, got -1"):
        demonstrations.sample_index(KEY, SUBSET, -1)
    with pytest.raises(ValueError, match="count must be at least 0, got -1"):
        demonstrations.sample_episodes(KEY, SUBSET, -1)


def test_a_sample_is_whole_transitions_of_the_pool():
    pool = pools.random_pool([3, 1, 4, 2, 6, 5, 1, 2]).transition
    sample = jax.jit(lambda key: demonstrations.sample(key, pool, SUBSET, 50))
    batch = jax.device_get(sample(KEY))
    step = np.argmax(batch.reward[:, None] == pool.reward, axis=1)
    assert set(step) <= {4, 5, 6, 7, 10, 11, 12, 13, 14, 15}
    chex.assert_trees_all_equal(batch, demonstrations.at(pool, step))


@given(lengths=pools.episode_lengths, discount=st.floats(0, 1))
def test_returns_equal_brute_force(lengths, discount):
    pool = pools.random_pool(lengths)
    starts = np.cumsum([0, *lengths[:-1]])
    rewards = [
        pool.transition.reward[start : start + length].astype(np.float64)
        for start, length in zip(starts, lengths, strict=True)
    ]
    np.testing.assert_allclose(
        demonstrations.returns(pool), [sum(reward) for reward in rewards], rtol=1e-12
    )
    expected = [
        sum(discount**k * later for k, later in enumerate(reward[t:]))
        for reward in rewards
        for t in range(len(reward))
    ]
    actual = demonstrations.discounted_returns(pool, discount)
    assert actual.dtype == np.float32
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("discount", [-0.1, 2.0, float("nan")])
def test_discounts_of_returns_are_between_0_and_1(discount):
    with pytest.raises(ValueError, match=f"discount must be between 0 and 1, got {discount}"):
        demonstrations.discounted_returns(pools.random_pool([3]), discount)


@given(lengths=pools.episode_lengths, data=st.data())
def test_kept_episodes_are_those_of_the_pool_in_its_order(lengths, data):
    pool = pools.random_pool(lengths)
    pool = pool._replace(
        metadata={
            "env": "A-v0",
            "seeds": list(range(len(lengths))),
            "author": "me",
            "description": "ten episodes",
            "other": 1,
        }
    )
    kept = np.array(
        data.draw(st.lists(st.booleans(), min_size=len(lengths), max_size=len(lengths)))
    )
    if not kept.any():
        with pytest.raises(ValueError, match="episodes stays"):
            demonstrations.keep(pool, kept)
        return
    found = demonstrations.keep(pool, kept)
    rows = np.isin(pool.episode, np.flatnonzero(kept))
    np.testing.assert_array_equal(found.transition.observation, pool.transition.observation[rows])
    np.testing.assert_array_equal(found.truncated, pool.truncated[rows])
    np.testing.assert_array_equal(demonstrations.episodes(found).length, np.array(lengths)[kept])
    seeds = np.flatnonzero(kept).tolist()
    assert found.metadata == {"env": "A-v0", "seeds": seeds, "author": "me"}
    # Every episode kept: the same pool.
    every = demonstrations.keep(pool, np.ones(len(lengths), bool))
    chex.assert_trees_all_equal(every[:3], pool[:3])


@pytest.mark.parametrize(
    ("kept", "error", "match"),
    [
        (np.array([True, False]), ValueError, "kept"),
        (np.array([1, 0, 1]), TypeError, "kept"),
    ],
)
def test_masks_of_another_kind_are_refused(kept, error, match):
    with pytest.raises(error, match=match):
        demonstrations.keep(pools.random_pool([2, 3, 1]), kept)
