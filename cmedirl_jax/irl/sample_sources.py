"""Where the samples of Algorithm 1 come from: single pairs, or whole trajectories.

Demonstrations come from the pool, the background from the replay (the paper: "all the samples
collected so far").
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax.agents import densities
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.data import episodes as episodes_lib
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.episodes import Episodes, EpisodesState
from cmedirl_jax.data.replay import Replay, ReplayState
from cmedirl_jax.types import Transition


class Samples(NamedTuple):
    """Pairs, with leaves `[B, ...]`, or trajectories, with leaves `[M, T, ...]`.

    Attributes:
        transition: the samples.
        mask: `[B]` or `[M, T]` bool; False where there is no sample.
        rows: their rows in the replay's storage; None for demonstrations.
    """

    transition: Transition
    mask: jax.Array
    rows: jax.Array | None


class SampleSource(NamedTuple):
    """A source of samples as pure functions of one seed.

    Attributes:
        batch_size: samples per update, of the demonstrations and of the background each.
        shares_pairs: whether `choose` takes the demonstrated pairs that it is given.
        init: `() -> state`, what is kept beside the replay; None if nothing is.
        record: `(state, step, ended) -> state`, after transition number `step` `[]` was added.
        cut: `(state, step) -> state`: transition number `step` will begin an episode, though none
            has ended.
        choose: `(key, subset, rows [n], count) -> [count] int32`, which demonstrations to take.
            `rows` are rows of the pool that were drawn for other uses too.
        demonstrations: `(pool, subset, chosen [B]) -> Samples`.
        background: `(state, replay_state, bits [B]) -> Samples`.
        total: `(log_density, mask) -> [B]`, the log density of each sample from those of its steps.
        mixture: `(log_densities [K, ...], mask, filled [K]) -> [B]`, that of each sample under a
            mixture of `K` policies, of which `filled` are there.
    """

    batch_size: int
    shares_pairs: bool
    init: Callable[[], Any]
    record: Callable[[Any, jax.Array, jax.Array], Any]
    cut: Callable[[Any, jax.Array], Any]
    choose: Callable[[jax.Array, DemonstrationSubset, jax.Array, int], jax.Array]
    demonstrations: Callable[[Transition, DemonstrationSubset, jax.Array], Samples]
    background: Callable[[Any, ReplayState, jax.Array], Samples]
    total: Callable[[jax.Array, jax.Array], jax.Array]
    mixture: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]


def pairs(replay: Replay, batch_size: int, recent: int | None) -> SampleSource:
    """Single state-action pairs.

    Args:
        replay: where the background lies.
        batch_size: pairs per update.
        recent: the background's latest transitions that are drawn from; None for all.
    """
    return SampleSource(
        batch_size=batch_size,
        shares_pairs=True,
        init=lambda: None,
        record=lambda state, step, ended: None,
        cut=lambda state, step: None,
        choose=lambda key, subset, rows, count: rows[:count],
        demonstrations=_demonstrated_pairs,
        background=functools.partial(_background_pairs, replay=replay, recent=recent),
        total=lambda log_density, mask: log_density,
        mixture=lambda log_densities, mask, filled: densities.transition_mixture(
            log_densities, filled
        ),
    )


def _demonstrated_pairs(
    pool: Transition, subset: DemonstrationSubset, chosen: jax.Array
) -> Samples:
    del subset
    return Samples(demonstrations_lib.at(pool, chosen), jnp.ones(chosen.shape, bool), None)


def _background_pairs(
    state: None,
    replay_state: ReplayState,
    bits: jax.Array,
    *,
    replay: Replay,
    recent: int | None,
) -> Samples:
    del state
    rows = replay.rows(replay_state, bits, recent)
    return Samples(replay.at(replay_state, rows), jnp.ones(rows.shape, bool), rows)


def trajectories(
    replay: Replay,
    replay_capacity: int,
    batch_size: int,
    recent: int | None,
    *,
    episodes: int,
    max_length: int,
) -> SampleSource:
    """Whole trajectories.

    Args:
        replay: where the background lies.
        replay_capacity: transitions that it holds.
        batch_size: trajectories per update.
        recent: only background trajectories within so many latest transitions are drawn; None for
            all that the replay still holds from end to end.
        episodes: the background's latest episodes that are drawn from.
        max_length: `T`, steps of the longest trajectory. Longer demonstrations are cut.

    Raises:
        ValueError: if `episodes`, `replay_capacity` or `max_length` is not positive.
        TypeError: if one of them is not an integer.
    """
    ring = episodes_lib.make(episodes, replay_capacity, max_length)
    return SampleSource(
        batch_size=batch_size,
        shares_pairs=False,
        init=ring.init,
        record=ring.step,
        cut=ring.cut,
        choose=lambda key, subset, rows, count: demonstrations_lib.sample_episodes(
            key, subset, count
        ),
        demonstrations=functools.partial(_demonstrated_trajectories, max_length=max_length),
        background=functools.partial(
            _background_trajectories, ring=ring, replay=replay, recent=recent
        ),
        total=lambda log_density, mask: jnp.sum(jnp.where(mask, log_density, 0.0), axis=-1),
        mixture=densities.trajectory_mixture,
    )


def _demonstrated_trajectories(
    pool: Transition, subset: DemonstrationSubset, chosen: jax.Array, *, max_length: int
) -> Samples:
    time = jnp.arange(max_length, dtype=jnp.int32)[None]
    start, length = (jnp.asarray(leaf)[chosen, None] for leaf in subset)
    # Rows past the pool's end are masked, but must be rows.
    rows = jnp.minimum(start + time, jnp.shape(pool.reward)[0] - 1)
    return Samples(demonstrations_lib.at(pool, rows), time < length, None)


def _background_trajectories(
    state: EpisodesState,
    replay_state: ReplayState,
    bits: jax.Array,
    *,
    ring: Episodes,
    replay: Replay,
    recent: int | None,
) -> Samples:
    rows, mask = ring.take(state, bits, replay_state.count, recent)
    return Samples(replay.at(replay_state, rows), mask, rows)
