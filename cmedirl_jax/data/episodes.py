"""Where the latest episodes lie in a replay buffer, so that whole trajectories can be sampled.

The steps themselves stay in the replay: an episode costs eight bytes here. Of an episode whose
first steps the replay has already overwritten nothing is sampled.
"""

from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax import checks


class EpisodesState(flax.struct.PyTreeNode):
    """The ring.

    Attributes:
        start: `[capacity]` int32, number of each episode's first transition, counted from the first
            that was ever added to the replay.
        length: `[capacity]` int32, its transitions; 0 where there is no episode yet.
        count: `[]` int32, episodes ever finished. Slot `count % capacity` is written next.
        current: `[]` int32, number of the running episode's first transition.
    """

    start: jax.Array
    length: jax.Array
    count: jax.Array
    current: jax.Array


class Episodes(NamedTuple):
    """A ring of episodes as pure functions.

    Attributes:
        init: `() -> EpisodesState`, empty.
        step: `(state, step, done) -> EpisodesState`, after transition number `step` `[]` int32 was
            added to the replay; `done` `[]` bool, that it ended an episode. ValueError for other
            shapes, TypeError for other dtypes.
        take: `(state, bits [M], steps, recent=None) -> (rows [M, T], mask [M, T])`: M of the ring's
            episodes, uniform with replacement, as rows of the replay's storage, after `steps`
            transitions were added. With `recent`, of those that lie in so many latest transitions.
            Where there is none, the mask is False throughout. TypeError if the bits are not
            unsigned integers, ValueError if `recent` is not positive.
    """

    init: Callable[[], EpisodesState]
    step: Callable[[EpisodesState, jax.Array, jax.Array], EpisodesState]
    take: Callable[..., tuple[jax.Array, jax.Array]]


def make(capacity: int, replay_capacity: int, max_length: int) -> Episodes:
    """A ring of the `capacity` latest episodes.

    Args:
        capacity: how many.
        replay_capacity: transitions that the replay holds.
        max_length: `T`, steps of the longest episode.

    Raises:
        ValueError: if one of them is not positive.
    """
    if min(capacity, replay_capacity, max_length) < 1:
        raise ValueError("capacity, replay_capacity and max_length must be positive")

    def init() -> EpisodesState:
        nothing = jnp.zeros((), jnp.int32)
        empty = jnp.zeros((capacity,), jnp.int32)
        return EpisodesState(empty, empty, nothing, nothing)

    def step(state: EpisodesState, step: jax.Array, done: jax.Array) -> EpisodesState:
        for name, given, kind in (("step", step, jnp.integer), ("done", done, jnp.bool_)):
            checks.shape(name, given, ())
            checks.kind(name, given, kind)
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

    def take(
        state: EpisodesState, bits: jax.Array, steps: jax.Array, recent: int | None = None
    ) -> tuple[jax.Array, jax.Array]:
        checks.kind("bits", bits, jnp.unsignedinteger)
        if recent is not None:
            checks.sizes(recent=recent)
        window = replay_capacity if recent is None else min(recent, replay_capacity)
        whole = (state.length > 0) & (state.start >= steps - window)
        # They are the latest ones, for starts only grow.
        held = jnp.sum(whole)
        age = (bits % jnp.maximum(held, 1).astype(jnp.uint32)).astype(jnp.int32)
        slot = (state.count - 1 - age) % capacity
        start, length = state.start[slot, None], state.length[slot, None]
        time = jnp.arange(max_length)
        return (start + time) % replay_capacity, (time < length) & (held > 0)

    return Episodes(init, step, take)
