"""A ring buffer of transitions with uniform sampling (the paper's 'replay memory', section 4.1).

A transition lies in one row of a packed `[capacity, D]` array: adding is one contiguous write and a
minibatch one gather. The only counter is the number of transitions ever added; who fills many
buffers in step may carry that number once, unbatched (`training` does).
"""

from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax import checks
from cmedirl_jax.types import EnvSpec, Transition


class ReplayState(flax.struct.PyTreeNode):
    """The buffer: `storage` `[capacity, D]` float32 and `count` `[]` int32, transitions ever added.

    Row `count % capacity` is written next; `min(count, capacity)` rows are filled.
    """

    storage: jax.Array
    count: jax.Array


class Replay(NamedTuple):
    """A replay buffer as pure functions.

    Attributes:
        init: `() -> ReplayState`, empty.
        add: `(state, transition) -> ReplayState`; overwrites the oldest once full. One transition:
            leaves `[O]`, `[A]` and `[]`, else ValueError, or TypeError for other dtypes.
        sample: `(key, state, batch_size, recent=None) -> Transition`, leaves `[batch_size, ...]`:
            uniform with replacement over what is there, or over its `recent` latest transitions.
            An empty buffer gives zeros. ValueError if `batch_size` is negative, or `recent` not
            positive.
        draw: `(key, batch_size) -> bits`, the randomness of `sample`, to draw ahead of time.
        take: `(state, bits, recent=None) -> Transition`; `sample` is `take` of `draw`. TypeError if
            the bits are not unsigned integers.
        rows: `(state, bits, recent=None) -> index`, the rows of the storage that `take` reads.
        at: `(state, index [...]) -> Transition`, leaves `[..., ...]`, what lies in these rows.
    """

    init: Callable[[], ReplayState]
    add: Callable[[ReplayState, Transition], ReplayState]
    sample: Callable[..., Transition]
    draw: Callable[[jax.Array, int], jax.Array]
    take: Callable[..., Transition]
    rows: Callable[..., jax.Array]
    at: Callable[[ReplayState, jax.Array], Transition]


def make(spec: EnvSpec, capacity: int) -> Replay:
    """A replay buffer of `capacity` transitions of `spec`'s sizes.

    Raises:
        ValueError: if `capacity` is not positive.
    """
    if capacity < 1:
        raise ValueError(f"replay capacity must be positive, got {capacity}")

    def init() -> ReplayState:
        return ReplayState(jnp.zeros((capacity, row_size(spec))), jnp.zeros((), jnp.int32))

    def add(state: ReplayState, transition: Transition) -> ReplayState:
        checks.transition_shapes(spec, transition, (), "transition")
        row = pack(spec, transition)
        position = state.count % capacity
        return ReplayState(state.storage.at[position].set(row), state.count + 1)

    def draw(key: jax.Array, batch_size: int) -> jax.Array:
        checks.counts(batch_size=batch_size)
        return jax.random.bits(key, (batch_size,), jnp.uint32)

    def rows(state: ReplayState, bits: jax.Array, recent: int | None = None) -> jax.Array:
        checks.kind("bits", bits, jnp.unsignedinteger)
        if recent is not None:
            checks.sizes(recent=recent)
        size = jnp.minimum(state.count, capacity if recent is None else min(recent, capacity))
        # The bias of a remainder is below size / 2^32: nothing beside sampling noise.
        age = (bits % jnp.maximum(size, 1).astype(jnp.uint32)).astype(jnp.int32)
        return (state.count - 1 - age) % capacity

    def at(state: ReplayState, index: jax.Array) -> Transition:
        return unpack(spec, state.storage[index])

    def take(state: ReplayState, bits: jax.Array, recent: int | None = None) -> Transition:
        return at(state, rows(state, bits, recent))

    def sample(
        key: jax.Array, state: ReplayState, batch_size: int, recent: int | None = None
    ) -> Transition:
        return take(state, draw(key, batch_size), recent)

    return Replay(init, add, sample, draw, take, rows, at)


def row_size(spec: EnvSpec) -> int:
    """`D`, the floats that one packed transition takes."""
    return 2 * spec.observation_dim + spec.action_dim + 2


def pack(spec: EnvSpec, transition: Transition) -> jax.Array:
    """A transition's leaves as rows `[..., D]` float32.

    Raises:
        ValueError: if a leaf is not of `spec`'s size.
        TypeError: if it is not of floats, or `terminated` not bool.
    """
    checks.transition_shapes(spec, transition, jnp.shape(transition.reward), "transition")
    return jnp.concatenate(
        [
            transition.observation,
            transition.action,
            jnp.asarray(transition.reward)[..., None],
            transition.next_observation,
            jnp.asarray(transition.terminated, jnp.float32)[..., None],
        ],
        axis=-1,
    )


def unpack(spec: EnvSpec, rows: jax.Array) -> Transition:
    """The transition in rows `[..., D]`: the inverse of `pack`.

    Raises:
        ValueError: if the rows are not of `row_size` floats.
        TypeError: if they are not floats.
    """
    checks.vectors("rows", rows, row_size(spec))
    o, a = spec.observation_dim, spec.action_dim
    return Transition(
        observation=rows[..., :o],
        action=rows[..., o : o + a],
        reward=rows[..., o + a],
        next_observation=rows[..., o + a + 1 : 2 * o + a + 1],
        terminated=rows[..., 2 * o + a + 1] > 0.5,
    )
