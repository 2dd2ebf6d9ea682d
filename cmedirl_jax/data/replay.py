"""A ring buffer of transitions with uniform sampling (the paper's 'replay memory', section 4.1).

    buffer = replay.make(env.spec, capacity=10_000)
    state = buffer.add(buffer.init(), transition)
    batch = buffer.sample(key, state, batch_size=32)

Each transition is one row of a packed `[capacity, D]` array: adding writes a contiguous row, and a
minibatch is one gather. The only counter is the number of transitions ever added. Buffers that are
filled in step can share that number, unbatched (`training` does so).
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax import checks
from cmedirl_jax.types import EnvSpec, Transition


class ReplayState(flax.struct.PyTreeNode):
    """The buffer.

    Attributes:
        storage: `[capacity, D]` float32, packed transitions; `min(count, capacity)` rows are
            filled, and row `count % capacity` is written next.
        count: `[]` int32, transitions ever added.
    """

    storage: jax.Array
    count: jax.Array


class Replay(NamedTuple):
    """A replay buffer as pure functions.

    Attributes:
        init: `() -> ReplayState`, empty.
        add: `(state, transition) -> ReplayState`, with one more transition (leaves `[O]`, `[A]` and
            `[]`); a full buffer overwrites its oldest one. Raises ValueError for wrong shapes and
            TypeError for wrong dtypes.
        sample: `(key, state, batch_size, recent=None) -> Transition`, leaves `[batch_size, ...]`,
            drawn uniformly with replacement from all transitions or from the `recent` latest ones.
            An empty buffer gives zeros. Raises ValueError if `batch_size` is negative or `recent`
            is not positive, TypeError if one of them is not an integer.
        draw: `(key, batch_size) -> bits`, the randomness of `sample`, to draw ahead of time. Raises
            as `sample`.
        take: `(state, bits, recent=None) -> Transition`; `sample` is `take` of `draw`. Raises
            ValueError if `recent` is not positive, TypeError if it is not an integer or the bits
            are not unsigned integers.
        rows: `(state, bits, recent=None) -> index`, the rows of the storage that `take` reads.
            Raises as `take`.
        at: `(state, index [...]) -> Transition`, the transitions in these rows, leaves
            `[..., ...]`. Raises ValueError if a known index is not one of a row, TypeError if the
            indices are not integers.
    """

    init: Callable[[], ReplayState]
    add: Callable[[ReplayState, Transition], ReplayState]
    sample: Callable[..., Transition]
    draw: Callable[[jax.Array, int], jax.Array]
    take: Callable[..., Transition]
    rows: Callable[..., jax.Array]
    at: Callable[[ReplayState, jax.Array], Transition]


def make(spec: EnvSpec, capacity: int) -> Replay:
    """Make a replay buffer of `capacity` transitions of `spec`'s sizes.

    Raises:
        ValueError: if `capacity` is not positive, or the specification contradicts itself.
        TypeError: if `capacity` is not an integer, or a size or a bound of the specification has a
            wrong type.
    """
    checks.env_spec(spec)
    checks.sizes(**{"replay capacity": capacity})
    rows = functools.partial(_rows, capacity)
    at = functools.partial(_at, spec)
    take = functools.partial(_take, at, rows)
    return Replay(
        init=functools.partial(_init, spec, capacity),
        add=functools.partial(_add, spec, capacity),
        sample=functools.partial(_sample, take),
        draw=_draw,
        take=take,
        rows=rows,
        at=at,
    )


def _init(spec: EnvSpec, capacity: int) -> ReplayState:
    return ReplayState(jnp.zeros((capacity, row_size(spec)), jnp.float32), jnp.zeros((), jnp.int32))


def _add(spec: EnvSpec, capacity: int, state: ReplayState, transition: Transition) -> ReplayState:
    checks.transition_shapes(spec, transition, (), "transition")
    row = pack(spec, transition)
    position = state.count % capacity
    return ReplayState(state.storage.at[position].set(row), state.count + 1)


def _sample(
    take: Callable[..., Transition],
    key: jax.Array,
    state: ReplayState,
    batch_size: int,
    recent: int | None = None,
) -> Transition:
    return take(state, _draw(key, batch_size), recent)


def _draw(key: jax.Array, batch_size: int) -> jax.Array:
    checks.counts(batch_size=batch_size)
    return jax.random.bits(key, (batch_size,), jnp.uint32)


def _take(
    at: Callable[[ReplayState, jax.Array], Transition],
    rows: Callable[..., jax.Array],
    state: ReplayState,
    bits: jax.Array,
    recent: int | None = None,
) -> Transition:
    return at(state, rows(state, bits, recent))


def _rows(
    capacity: int, state: ReplayState, bits: jax.Array, recent: int | None = None
) -> jax.Array:
    checks.kind("bits", bits, jnp.unsignedinteger)
    if recent is not None:
        checks.sizes(recent=recent)
    size = jnp.minimum(state.count, capacity if recent is None else min(recent, capacity))
    # The remainder favours some rows by less than size / 2^32, far below sampling noise.
    age = (bits % jnp.maximum(size, 1).astype(jnp.uint32)).astype(jnp.int32)
    return (state.count - 1 - age) % capacity


def _at(spec: EnvSpec, state: ReplayState, index: jax.Array) -> Transition:
    checks.indices(len(state.storage), index=index)
    return unpack(spec, state.storage[index])


def row_size(spec: EnvSpec) -> int:
    """`D`, the number of floats in a packed transition."""
    return 2 * spec.observation_dim + spec.action_dim + 2


def pack(spec: EnvSpec, transition: Transition) -> jax.Array:
    """A transition's leaves as rows `[..., D]` float32.

    Raises:
        ValueError: if a leaf does not have `spec`'s size.
        TypeError: if a leaf is not of floats, or `terminated` is not bool.
    """
    checks.transition_shapes(spec, transition, jnp.shape(transition.reward), "transition")
    whole = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), transition)
    return jnp.concatenate(
        [
            whole.observation,
            whole.action,
            whole.reward[..., None],
            whole.next_observation,
            whole.terminated[..., None],
        ],
        axis=-1,
    )


def unpack(spec: EnvSpec, rows: jax.Array) -> Transition:
    """The transition in rows `[..., D]`: the inverse of `pack`.

    Raises:
        ValueError: if a row does not have `row_size` entries.
        TypeError: if the rows are not of floats.
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
