import collections
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cmedirl_jax import envs
from cmedirl_jax.data import replay
from cmedirl_jax.types import Transition

SPEC = envs.make("MountainCarContinuous-v0").spec
KEY = jax.random.key(0)
# XLA flushes subnormal numbers to zero.
FINITE = st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False, width=32)


@functools.cache
def jitted(capacity):
    buffer = replay.make(SPEC, capacity)
    sample = jax.jit(buffer.sample, static_argnums=(2, 3))
    return buffer._replace(add=jax.jit(buffer.add), sample=sample)


@jax.jit
def packed(original):
    """Rows, and what they unpack to."""
    rows = replay.pack(SPEC, original)
    return rows, replay.unpack(SPEC, rows)


unpack = jax.jit(lambda row: replay.unpack(SPEC, row))


def transition(number):
    """A transition that carries its number in every leaf."""
    number = np.float32(number)
    return Transition(
        observation=np.array([number, -number]),
        action=np.array([number + 0.25]),
        reward=number,
        next_observation=np.array([number + 1, -number - 1]),
        terminated=np.bool_(number % 2),
    )


def stacked(numbers):
    return jax.tree.map(lambda *rows: np.stack(rows), *map(transition, numbers))


def filled(buffer, count):
    state = buffer.init()
    for number in range(count):
        state = buffer.add(state, transition(number))
    return state


def assert_equal(actual, expected):
    chex.assert_trees_all_equal(actual, expected)


@given(capacity=st.sampled_from([1, 2, 5]), count=st.integers(0, 13))
def test_storage_holds_the_latest_transitions(capacity, count):
    state = filled(jitted(capacity), count)
    model = collections.deque(map(transition, range(count)), maxlen=capacity)
    assert state.count == count
    oldest = count % capacity if count > capacity else 0
    rows = np.roll(np.asarray(state.storage), -oldest, axis=0)
    for row, expected in zip(rows, model, strict=False):
        assert_equal(unpack(row), expected)
    assert not rows[len(model) :].any()


@given(
    capacity=st.sampled_from([2, 5]),
    count=st.integers(1, 13),
    recent=st.sampled_from([None, 1, 3, 20]),
)
def test_samples_are_the_transitions_of_the_recent_window(capacity, count, recent):
    buffer = jitted(capacity)
    batch = jax.device_get(buffer.sample(KEY, filled(buffer, count), 100, recent))
    size = min(count, capacity, recent or capacity)
    assert set(batch.reward) == set(range(count - size, count))
    assert_equal(batch, stacked(batch.reward))


@pytest.mark.parametrize("count", [7, 23])
@pytest.mark.parametrize("recent", [None, 4])
def test_sampling_is_uniform(count, recent):
    buffer = jitted(10)
    batch = buffer.sample(KEY, filled(buffer, count), 20_000, recent)
    observed = np.unique(batch.reward, return_counts=True)[1]
    assert len(observed) == min(count, recent or 10)
    assert scipy.stats.chisquare(observed).pvalue > 1e-3


def transitions(leading):
    def arrays(*shape):
        return hnp.arrays(np.float32, (*leading, *shape), elements=FINITE)

    return st.builds(
        Transition, arrays(2), arrays(1), arrays(), arrays(2), hnp.arrays(bool, leading)
    )


@given(st.sampled_from([(), (3,), (2, 4)]).flatmap(transitions))
def test_unpack_inverts_pack(original):
    rows, unpacked = packed(original)
    assert rows.shape == (*original.reward.shape, replay.row_size(SPEC))
    assert_equal(unpacked, original)
    assert unpacked.terminated.dtype == jnp.bool_


def test_vmapped_buffers_do_not_mix():
    buffer = replay.make(SPEC, 4)
    offsets = np.array([0, 100, 200])
    add = jax.jit(jax.vmap(buffer.add))
    states = jax.jit(jax.vmap(lambda _: buffer.init()))(offsets)
    for number in range(6):
        states = add(states, stacked(offsets + number))
    keys = jax.random.split(KEY, 3)
    batch = jax.jit(jax.vmap(lambda key, state: buffer.sample(key, state, 100)))(keys, states)
    for offset, rewards in zip(offsets, np.asarray(batch.reward), strict=True):
        assert set(rewards) == set(range(offset + 2, offset + 6))


def test_sample_is_take_of_draw():
    buffer = replay.make(SPEC, 5)

    @jax.jit
    def both(key, state):
        taken = buffer.take(state, buffer.draw(key, 16), 3)
        return buffer.sample(key, state, 16, 3), taken

    assert_equal(*both(KEY, filled(jitted(5), 8)))


def test_an_empty_buffer_gives_zeros():
    buffer = jitted(3)
    batch = jax.device_get(buffer.sample(KEY, buffer.init(), 4, None))
    assert batch.terminated.dtype == jnp.bool_
    assert_equal(batch, jax.tree.map(np.zeros_like, batch))


@pytest.mark.parametrize("capacity", [0, -1])
def test_capacity_must_be_positive(capacity):
    with pytest.raises(ValueError, match=f"capacity must be at least 1, got {capacity}"):
        replay.make(SPEC, capacity)


@pytest.mark.parametrize("leaf", ["observation", "action", "next_observation"])
def test_leaves_of_another_size_are_refused(leaf):
    wrong = transition(1)._replace(**{leaf: np.zeros(3, np.float32)})
    with pytest.raises(ValueError, match=f"expected leaves of shape .*{leaf}"):
        replay.pack(SPEC, wrong)


@pytest.mark.parametrize("width", [4, 9])
def test_rows_of_another_width_are_refused(width):
    with pytest.raises(ValueError, match=rf"rows: expected shape \(5, 7\), got \(5, {width}\)"):
        replay.unpack(SPEC, jnp.zeros((5, width)))


def test_impossible_samples_are_refused():
    buffer = replay.make(SPEC, 3)
    state = buffer.init()
    with pytest.raises(ValueError, match="batch_size must be at least 0, got -1"):
        buffer.sample(KEY, state, -1)
    for recent in (0, -5):
        with pytest.raises(ValueError, match=f"recent must be at least 1, got {recent}"):
            buffer.sample(KEY, state, 3, recent)
    for bits in (jnp.zeros(3), jnp.zeros(3, jnp.int32)):
        with pytest.raises(TypeError, match=f"bits: expected unsigned integers, got {bits.dtype}"):
            buffer.take(state, bits)


def test_a_batch_of_size_zero_is_empty():
    buffer = jitted(3)
    assert buffer.sample(KEY, buffer.init(), 0, None).observation.shape == (0, 2)


def test_other_values_do_not_recompile():
    buffer = jitted(3)
    add = jax.jit(replay.make(SPEC, 3).add)
    add(buffer.init(), transition(1))
    add(filled(buffer, 5), transition(2))
    assert add._cache_size() == 1


def test_add_can_donate_its_state():
    buffer = replay.make(SPEC, 3)
    before = filled(jitted(3), 2)
    after = jax.jit(buffer.add, donate_argnums=0)(before, transition(2))
    assert before.storage.is_deleted()
    assert_equal(after, filled(jitted(3), 3))
