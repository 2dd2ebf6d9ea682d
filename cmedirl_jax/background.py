"""What Algorithm 1 samples: pairs or trajectories of demonstrations and background, with densities.

The background is the replay (the paper: "all the samples collected so far"). Beside it lies here
what importance weights and trajectories need, and nothing where they are not asked for: the
recorded density of each action, snapshots of the actor, where the episodes lie, and a Gaussian
fitted to the demonstrations.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax import demonstrations as demonstrations_lib
from cmedirl_jax import episodes as episodes_lib
from cmedirl_jax import networks as networks_lib
from cmedirl_jax.demonstrations import DemonstrationSubset
from cmedirl_jax.exploration import Exploration
from cmedirl_jax.irl import densities
from cmedirl_jax.irl.objectives import Objective
from cmedirl_jax.networks import ActorCritic
from cmedirl_jax.replay import Replay, ReplayState
from cmedirl_jax.schedules import RewardSchedule
from cmedirl_jax.types import EnvSpec, Params, RewardBatch, Transition

FITTED_PAIRS = 1024
"""Demonstrated pairs that the Gaussian is fitted to, drawn with replacement."""


class BackgroundState(flax.struct.PyTreeNode):
    """What is kept beside the replay of `C` transitions; None is what nothing needs.

    Attributes:
        log_density: `[C]`, of each of the replay's actions as it was drawn.
        snapshots: actor parameters `[K, ...]`, one for every `snapshot_period` steps. Each explores
            as it did at the step at which it was taken.
        episodes: an `EpisodesState`, where the latest episodes lie in the replay.
        demonstrator: the demonstrations' behaviour as a `ConditionalGaussian`, an approximation.
    """

    log_density: Any
    snapshots: Params
    episodes: Any
    demonstrator: Any


class Draws(NamedTuple):
    """The randomness of `n` samples of each kind.

    Attributes:
        background: `[n]` uint32, of pairs or episodes of the replay.
        demonstrations: `[n]` int32, rows of the pool, or episodes of the subset.
    """

    background: jax.Array
    demonstrations: jax.Array


class Background(NamedTuple):
    """The samples of one seed as pure functions.

    Attributes:
        init: `(key, actor, pool, subset) -> BackgroundState`.
        record: `(state, actor, step, log_density, ended) -> BackgroundState`, after transition
            number `step` (unbatched under `vmap`) was added to the replay.
        take: `(state, pool, subset, replay_state, exploration_state, draws) -> (demonstrations,
            background)`, two `RewardBatch`es for a `RewardLearner`.
    """

    init: Callable[..., BackgroundState]
    record: Callable[..., BackgroundState]
    take: Callable[..., tuple[RewardBatch, RewardBatch]]


class _Sampled(NamedTuple):
    """Transitions `[B, ...]` or `[M, T, ...]`, which are there, and their rows in the replay."""

    transition: Transition
    mask: jax.Array
    rows: Any


def make(
    spec: EnvSpec,
    networks: ActorCritic,
    exploration: Exploration,
    replay: Replay,
    capacity: int,
    schedule: RewardSchedule,
    *,
    objective: Objective = "visitation",
    append: bool = True,
) -> Background:
    """Make the samples of a reward learner.

    Args:
        spec: the environment's.
        networks: whose actor behaves.
        exploration: how it behaves.
        replay: where its steps lie.
        capacity: of the replay.
        schedule: which weights, how many snapshots and episodes.
        objective: of the learner: pairs or trajectories.
        append: whether the demonstrations join the samples, and so the mixture they are drawn from.

    Raises:
        ValueError: if the schedule's `snapshots`, `snapshot_period` or `episodes` are not positive.
    """
    if min(schedule.snapshots, schedule.snapshot_period) < 1:
        raise ValueError(
            "snapshots and snapshot_period must be positive, "
            f"got {schedule.snapshots} and {schedule.snapshot_period}"
        )
    whole = objective == "trajectory"
    recorded, fused = (schedule.weights == kind for kind in ("recorded", "fusion"))
    ring = episodes_lib.make(schedule.episodes, capacity, spec.max_episode_steps)
    demonstrated = 0.5 if append else 0.0  # As many demonstrations as samples of the background.

    def init(
        key: jax.Array, actor: Params, pool: Transition, subset: DemonstrationSubset
    ) -> BackgroundState:
        demonstrator = None
        if recorded or fused:
            index = demonstrations_lib.sample_index(key, subset, FITTED_PAIRS)
            pairs = demonstrations_lib.at(pool, index)
            demonstrator = densities.fit_gaussian(spec, pairs.observation, pairs.action)
        return BackgroundState(
            log_density=jnp.zeros((capacity,)) if recorded else None,
            snapshots=jax.tree.map(
                lambda leaf: jnp.zeros((schedule.snapshots, *leaf.shape), leaf.dtype), actor
            )
            if fused
            else None,
            episodes=ring.init() if whole else None,
            demonstrator=demonstrator,
        )

    def record(
        state: BackgroundState,
        actor: Params,
        step: jax.Array,
        log_density: jax.Array,
        ended: jax.Array,
    ) -> BackgroundState:
        if recorded:
            state = state.replace(
                log_density=state.log_density.at[step % capacity].set(log_density)
            )
        if fused:
            slot = step // schedule.snapshot_period % schedule.snapshots
            due = step % schedule.snapshot_period == 0
            # One slot is written at every step: a branch would copy all of them.
            snapshots = jax.tree.map(
                lambda kept, leaf: kept.at[slot].set(jnp.where(due, leaf, kept[slot])),
                state.snapshots,
                actor,
            )
            state = state.replace(snapshots=snapshots)
        if whole:
            state = state.replace(episodes=ring.step(state.episodes, step, ended))
        return state

    def gather(
        state: BackgroundState,
        pool: Transition,
        subset: DemonstrationSubset,
        replay_state: ReplayState,
        draws: Draws,
    ) -> tuple[_Sampled, _Sampled]:
        if not whole:
            pairs = demonstrations_lib.at(pool, draws.demonstrations)
            rows = replay.rows(replay_state, draws.background, schedule.recent)
            every = jnp.ones(rows.shape, bool)
            return _Sampled(pairs, every, None), _Sampled(
                replay.at(replay_state, rows), every, rows
            )
        time = jnp.arange(spec.max_episode_steps)
        start, length = (leaf[draws.demonstrations, None] for leaf in subset)
        last = jnp.shape(pool.reward)[0] - 1
        episodes = demonstrations_lib.at(pool, jnp.minimum(start + time, last))
        rows, mask = ring.take(
            state.episodes, draws.background, replay_state.count, schedule.recent
        )
        return _Sampled(episodes, time < length, None), _Sampled(
            replay.at(replay_state, rows), mask, rows
        )

    def total(log_density: jax.Array, mask: jax.Array) -> jax.Array:
        """Of a trajectory: the sum over its steps. Of a pair: what it is."""
        return jnp.sum(jnp.where(mask, log_density, 0.0), axis=-1) if whole else log_density

    def of_demonstrator(state: BackgroundState, sampled: _Sampled) -> jax.Array:
        observation, action = sampled.transition.observation, sampled.transition.action
        log_density = densities.gaussian_policy(spec, state.demonstrator, observation, action)
        return total(log_density, sampled.mask)

    def of_mixture(
        state: BackgroundState, sampled: _Sampled, exploration_state: Any, count: jax.Array
    ) -> jax.Array:
        """Of the snapshots, and of the demonstrator in the share that it has of the samples."""

        def of_snapshot(actor: Params, step: jax.Array) -> jax.Array:
            greedy = networks_lib.policy(networks, actor, sampled.transition.observation)
            return exploration.log_density(
                exploration_state, greedy, sampled.transition.action, step
            )

        # The slots hold the latest snapshots up to number `latest`; a negative number is none yet.
        latest = (count - 1) // schedule.snapshot_period
        number = latest - (latest - jnp.arange(schedule.snapshots)) % schedule.snapshots
        filled = number >= 0
        each = jax.vmap(of_snapshot)(state.snapshots, number * schedule.snapshot_period)
        if whole:
            mean = densities.trajectory_mixture(each, sampled.mask, filled)
        else:
            mean = densities.transition_mixture(each, filled)
        return jnp.logaddexp(
            jnp.log(demonstrated) + of_demonstrator(state, sampled),
            jnp.log1p(-demonstrated) + mean,
        )

    def take(
        state: BackgroundState,
        pool: Transition,
        subset: DemonstrationSubset,
        replay_state: ReplayState,
        exploration_state: Any,
        draws: Draws,
    ) -> tuple[RewardBatch, RewardBatch]:
        both = demonstrations, background = gather(state, pool, subset, replay_state, draws)
        match schedule.weights:
            case "uniform":
                found = [jnp.zeros(sampled.mask.shape[:1]) for sampled in both]
            case "recorded":
                found = [
                    of_demonstrator(state, demonstrations),
                    total(state.log_density[background.rows], background.mask),
                ]
            case "fusion":
                found = [
                    of_mixture(state, sampled, exploration_state, replay_state.count)
                    for sampled in both
                ]
        first, second = (
            RewardBatch(sampled.transition, log_density, sampled.mask)
            for sampled, log_density in zip(both, found, strict=True)
        )
        return first, second

    return Background(init, record, take)
