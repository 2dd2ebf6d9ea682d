import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.data import episodes
from tests.support.episodes import played

MAX_LENGTH = 4
BITS = np.random.default_rng(0).integers(0, 2**32, 20_000, dtype=np.uint32)


@functools.cache
def jitted(capacity, replay_capacity):
    ring = episodes.make(capacity, replay_capacity, MAX_LENGTH)
    take = jax.jit(ring.take, static_argnums=3)
    # All seeds share the step number, so `vmap` leaves it unbatched.
    together = jax.jit(jax.vmap(ring.step, in_axes=(0, None, 0)))
    return ring._replace(step=jax.jit(ring.step), take=take), together


def lasting(lengths, running=0):
    """Which steps end an episode, for consecutive episodes and a last one that still runs."""
    done = np.zeros(sum(lengths) + running, bool)
    done[np.cumsum(lengths, dtype=int) - 1] = True
    return done


def after(ring, done):
    state = ring.init()
    for step, ended in enumerate(done):
        state = ring.step(state, step, ended)
    return state


lengths = st.lists(st.integers(1, MAX_LENGTH), max_size=12)
sizes = st.tuples(st.sampled_from([1, 3]), st.sampled_from([1, 7, 50]))


@given(lengths, st.integers(0, MAX_LENGTH - 1), sizes)
def test_take_gives_one_of_the_latest_episodes_or_nothing(lengths, running, sizes):
    (ring, _), done = jitted(*sizes), lasting(lengths, running)
    finished, stored = played(done, sizes[1])
    rows, mask = jax.device_get(ring.take(after(ring, done), BITS[:100], len(done)))
    assert rows.shape == mask.shape == (100, MAX_LENGTH)
    assert rows.min() >= 0
    assert rows.max() < sizes[1]
    taken = {tuple(stored[row] for row in rows[i][mask[i]]) for i in range(100)}
    latest = finished[-sizes[0] :]
    expected = {episode for episode in latest if set(episode) <= set(stored)}
    assert taken == (expected or {()})
    # The steps come first, the padding last.
    assert not np.any(mask[:, 1:] & ~mask[:, :-1])


def test_an_empty_ring_holds_nothing():
    ring, _ = jitted(3, 7)
    for state, steps in ((ring.init(), 0), (after(ring, [False, False]), 2)):
        _, mask = ring.take(state, BITS[:100], steps)
        assert not np.any(mask)


@pytest.mark.parametrize("count", [2, 8])
def test_sampling_is_uniform_over_the_episodes_held(count):
    ring, _ = jitted(3, 50)
    done = lasting([1, 4, 3, 2, 1, 2, 4, 1][:count])
    rows, _ = ring.take(after(ring, done), BITS, len(done))
    observed = np.unique(np.asarray(rows)[:, 0], return_counts=True)[1]
    assert len(observed) == min(count, 3)
    assert scipy.stats.chisquare(observed).pvalue > 1e-3


def test_only_episodes_within_the_recent_transitions_are_taken():
    ring, _ = jitted(3, 50)
    state = after(ring, lasting([4, 3, 2]))
    for recent, longest in ((1, 0), (4, 2), (5, 3), (9, 4)):
        _, mask = ring.take(state, BITS[:100], 9, recent)
        assert np.asarray(mask).sum(axis=1).max() == longest


def test_an_episode_goes_with_its_first_transition():
    ring, _ = jitted(1, 7)
    state = after(ring, lasting([3]))
    for steps in range(3, 9):
        _, mask = ring.take(state, BITS[:1], steps)
        assert np.asarray(mask).sum() == (3 if steps <= 7 else 0)


def test_an_episode_that_is_cut_off_is_never_sampled():
    ring = episodes.make(4, 50, 10)
    state = ring.init()
    # Two whole episodes of 2 steps with one of 3 between them, which nothing ended.
    for step, done in enumerate([False, True, False, False, False, False, True]):
        if step == 5:
            state = ring.cut(state, jnp.int32(5))
        state = ring.step(state, jnp.int32(step), jnp.asarray(done))
    assert state.count == 2
    assert np.asarray(state.start)[:2].tolist() == [0, 5]
    assert np.asarray(state.length)[:2].tolist() == [2, 2]


def test_vmapped_rings_do_not_mix():
    ring, together = jitted(3, 7)
    done = np.stack([lasting([1, 2, 3, 4]), lasting([4, 4], 2), lasting([], 10)])
    states = jax.tree.map(lambda leaf: jnp.asarray(np.stack([leaf] * 3)), ring.init())
    for step in range(10):
        states = together(states, step, done[:, step])
    states = jax.device_get(states)
    for index, ends in enumerate(done):
        alone = after(ring, ends)
        chex.assert_trees_all_equal(jax.tree.map(lambda leaf, i=index: leaf[i], states), alone)
    assert together._cache_size() == 1


@pytest.mark.parametrize("sizes", [(0, 7, 4), (3, 0, 4), (3, 7, 0)])
def test_sizes_must_be_positive(sizes):
    with pytest.raises(ValueError, match="must be at least 1, got 0"):
        episodes.make(*sizes)


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.float32])
def test_bits_are_unsigned(dtype):
    ring, _ = jitted(3, 7)
    with pytest.raises(TypeError, match="bits: expected unsigned integers, got "):
        ring.take(ring.init(), jnp.zeros(3, dtype), 0)


def test_a_window_of_size_zero_is_refused():
    ring, _ = jitted(3, 7)
    with pytest.raises(ValueError, match="recent must be at least 1, got 0"):
        ring.take(ring.init(), BITS[:3], 0, 0)


def test_one_step_of_one_ring_is_recorded():
    ring, _ = jitted(3, 7)
    with pytest.raises(ValueError, match=r"done: expected shape \(\), got \(2,\)"):
        ring.step(ring.init(), 0, np.array([True, False]))
    with pytest.raises(TypeError, match="done: expected bool, got float32"):
        ring.step(ring.init(), 0, np.float32(1.0))
