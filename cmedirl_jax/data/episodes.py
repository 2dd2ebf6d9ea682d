"""Where the latest episodes lie in a replay buffer, so that whole trajectories can be sampled.

The steps themselves stay in the replay; an episode takes eight bytes here. An episode is not
sampled once the replay has overwritten its first step.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax import checks


class EpisodesState(flax.struct.PyTreeNode):
    """The ring.

    Attributes:
        start: `[capacity]` int32, the number of each episode's first transition; the first one that
            was ever added to the replay has number 0.
        length: `[capacity]` int32, transitions of each episode; 0: no episode yet.
        count: `[]` int32, episodes ever finished; slot `count % capacity` is written next.
        current: `[]` int32, the number of the running episode's first transition.
    """

    start: jax.Array
    length: jax.Array
    count: jax.Array
    current: jax.Array


class Episodes(NamedTuple):
    """A ring of episodes as pure functions.

    Attributes:
        init: `() -> EpisodesState`, empty.
        step: `(state, step, done) -> EpisodesState`, to call after transition number `step` `[]`
            int32 was added to the replay; `done` `[]` bool says whether it ended an episode. Raises
            ValueError for wrong shapes and TypeError for wrong dtypes.
        cut: `(state, step) -> EpisodesState`: the next transition is number `step` and begins an
            episode; the running one is dropped.
        take: `(state, bits [M], steps, recent=None) -> (rows [M, T], mask [M, T])`, M episodes
            drawn uniformly with replacement, as rows of the replay's storage, after `steps`
            transitions were added. `recent` restricts them to episodes that lie within so many
            latest transitions. If there is none, the mask is False throughout. Raises TypeError if
            the bits are not unsigned integers or `recent` is no integer, ValueError if `recent` is
            not positive.
    """

    init: Callable[[], EpisodesState]
    step: Callable[[EpisodesState, jax.Array, jax.Array], EpisodesState]
    cut: Callable[[EpisodesState, jax.Array], EpisodesState]
    take: Callable[..., tuple[jax.Array, jax.Array]]


def make(capacity: int, replay_capacity: int, max_length: int) -> Episodes:
    """Make a ring of the `capacity` latest episodes.

    Args:
        capacity: episodes in the ring.
        replay_capacity: transitions in the replay.
        max_length: `T`, transitions of the longest episode.

    Raises:
        ValueError: if one of them is not positive.
        TypeError: if one is not an integer.
    """
    checks.sizes(capacity=capacity, replay_capacity=replay_capacity, max_length=max_length)
    return Episodes(
        init=functools.partial(_init, capacity),
        step=functools.partial(_step, capacity),
        cut=lambda state, step: state.replace(current=jnp.asarray(step, jnp.int32)),
        take=functools.partial(_take, capacity, replay_capacity, max_length),
    )


def _init(capacity: int) -> EpisodesState:
    zero = jnp.zeros((), jnp.int32)
    empty = jnp.zeros((capacity,), jnp.int32)
    return EpisodesState(empty, empty, zero, zero)


def _step(capacity: int, state: EpisodesState, step: jax.Array, done: jax.Array) -> EpisodesState:
    for name, array, kind in (("step", step, jnp.integer), ("done", done, jnp.bool_)):
        checks.shape(name, array, ())
        checks.kind(name, array, kind)
    slot = state.count % capacity
    following = jnp.asarray(step + 1, jnp.int32)
    start = jnp.where(done, state.current, state.start[slot])
    length = jnp.where(done, following - state.current, state.length[slot])
    return EpisodesState(
        start=state.start.at[slot].set(start),
        length=state.length.at[slot].set(length),
        count=state.count + done,
        current=jnp.where(done, following, state.current),
    )


def _take(
    capacity: int,
    replay_capacity: int,
    max_length: int,
    state: EpisodesState,
    bits: jax.Array,
    steps: jax.Array,
    recent: int | None = None,
) -> tuple[jax.Array, jax.Array]:
    checks.kind("bits", bits, jnp.unsignedinteger)
    if recent is not None:
        checks.sizes(recent=recent)
    # Starts only grow, so the episodes that lie within the window are the latest ones.
    window = replay_capacity if recent is None else min(recent, replay_capacity)
    whole = (state.length > 0) & (state.start >= steps - window)
    held = jnp.sum(whole)

    # Draw among them, and read their rows.
    age = (bits % jnp.maximum(held, 1).astype(jnp.uint32)).astype(jnp.int32)
    slot = (state.count - 1 - age) % capacity
    start, length = state.start[slot, None], state.length[slot, None]
    time = jnp.arange(max_length, dtype=jnp.int32)[None]
    return (start + time) % replay_capacity, (time < length) & (held > 0)
