"""What Algorithm 1 samples for an update of the reward: demonstrations and background.

A sampler puts together where samples come from (`sample_sources`) and which law they came from
(`sample_weights`). It keeps beside the replay what these two need, and nothing else.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.struct
import jax

from cmedirl_jax import ranges
from cmedirl_jax.agents.exploration import Exploration
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.replay import Replay, ReplayState
from cmedirl_jax.irl import sample_sources, sample_weights
from cmedirl_jax.irl.objectives import OBJECTIVES, ObjectiveName
from cmedirl_jax.irl.sample_sources import SampleSource
from cmedirl_jax.irl.sample_weights import SampleWeights
from cmedirl_jax.networks import ActorCritic
from cmedirl_jax.ranges import Size
from cmedirl_jax.types import EnvSpec, Params, RewardBatch, Transition


@dataclasses.dataclass(frozen=True)
class RewardBatchSettings:
    """Which samples the reward learns from. All static.

    Attributes:
        batch_size: Demonstrated pairs per update, and background pairs per update.
        recent: Background: the latest transitions of the replay, or the episodes that lie in them;
            None: all collected so far.
        weights: Weights of the samples of "maxent": all alike, 1 / the density recorded when the
            action was drawn, or 1 / the mixture of snapshots of the policy and, where
            demonstrations are appended, of their fitted Gaussian, in the same shares everywhere.
        snapshots: Snapshots of the policy in the mixture, the latest ones; they must reach back as
            `recent`.
        snapshot_period: Environment steps between snapshots.
        trajectories: Demonstrated trajectories per update of the "trajectory" objective, and as
            many of the background. An update costs their steps, up to the time limit of each: take
            a long `period`.
        episodes: Episodes of the background, the latest ones, that trajectories are drawn from at
            most.
    """

    batch_size: Size = 32
    recent: Size | None = 2000
    weights: Literal["uniform", "recorded", "fusion"] = "uniform"
    snapshots: Size = 8
    snapshot_period: Size = 250
    trajectories: Size = 8
    episodes: Size = 32


class SamplerState(flax.struct.PyTreeNode):
    """What is kept beside the replay; None is what nothing needs.

    Attributes:
        source: of the `SampleSource`: where the latest episodes lie in the replay.
        weights: of the `SampleWeights`: recorded densities, or snapshots of the actor; and the
            demonstrations' fitted behaviour.
    """

    source: Any
    weights: Any


class SampleDraws(NamedTuple):
    """The randomness of `n` samples of each kind.

    Attributes:
        background: `[n]` uint32, of pairs or episodes of the replay.
        demonstrations: `[n]` int32, rows of the pool, or episodes of the subset.
    """

    background: jax.Array
    demonstrations: jax.Array


class RewardSampler(NamedTuple):
    """The samples of one seed as pure functions.

    Attributes:
        batch_size: samples of each kind in a batch: pairs or trajectories.
        shares_pairs: see `SampleSource`.
        choose: see `SampleSource`.
        init: `(key, actor, pool, subset) -> SamplerState`.
        record: `(state, actor, step, log_density, ended) -> SamplerState`, after transition
            number `step` (unbatched under `vmap`) was added to the replay.
        cut: `(state, step) -> SamplerState`: transition number `step` will begin an episode, though
            none has ended.
        take: `(state, pool, subset, replay_state, exploration_state, draws) -> (demonstrations,
            background)`, two `RewardBatch`es for a `RewardLearner`.
    """

    batch_size: int
    shares_pairs: bool
    choose: Callable[[jax.Array, DemonstrationSubset, jax.Array, int], jax.Array]
    init: Callable[..., SamplerState]
    record: Callable[..., SamplerState]
    cut: Callable[[SamplerState, jax.Array], SamplerState]
    take: Callable[..., tuple[RewardBatch, RewardBatch]]


def make(
    spec: EnvSpec,
    networks: ActorCritic,
    exploration: Exploration,
    replay: Replay,
    capacity: int,
    settings: RewardBatchSettings,
    *,
    objective: ObjectiveName = "visitation",
    append: bool = True,
) -> RewardSampler:
    """Make the sampler of a reward learner.

    Args:
        spec: the environment's.
        networks: whose actor behaves.
        exploration: how it behaves.
        replay: where its steps lie.
        capacity: of the replay.
        settings: how many samples, and their weights.
        objective: of the learner: pairs or trajectories.
        append: whether the demonstrations join the samples, and so the mixture they are drawn from.

    Raises:
        ValueError: if a number of the settings is out of range, there is no such objective, or
            trajectories are asked of a `capacity` that is not positive.
        TypeError: if trajectories are asked of a `capacity` that is not an integer.
    """
    ranges.check(settings)
    source = _source(spec, replay, capacity, settings, objective)
    match settings.weights:
        case "uniform":
            weights = sample_weights.uniform()
        case "recorded":
            weights = sample_weights.recorded(spec, source, capacity)
        case "fusion":
            weights = sample_weights.mixture(
                spec,
                networks,
                exploration,
                source,
                snapshots=settings.snapshots,
                period=settings.snapshot_period,
                append=append,
            )
    return RewardSampler(
        batch_size=source.batch_size,
        shares_pairs=source.shares_pairs,
        choose=source.choose,
        init=functools.partial(_init, source=source, weights=weights),
        record=functools.partial(_record, source=source, weights=weights),
        cut=lambda state, step: state.replace(source=source.cut(state.source, step)),
        take=functools.partial(_take, source=source, weights=weights),
    )


def _source(
    spec: EnvSpec,
    replay: Replay,
    capacity: int,
    settings: RewardBatchSettings,
    objective: ObjectiveName,
) -> SampleSource:
    if not OBJECTIVES[objective].trajectories:
        return sample_sources.pairs(replay, settings.batch_size, settings.recent)
    return sample_sources.trajectories(
        replay,
        capacity,
        settings.trajectories,
        settings.recent,
        episodes=settings.episodes,
        max_length=spec.max_episode_steps,
    )


def _init(
    key: jax.Array,
    actor: Params,
    pool: Transition,
    subset: DemonstrationSubset,
    *,
    source: SampleSource,
    weights: SampleWeights,
) -> SamplerState:
    return SamplerState(source.init(), weights.init(key, actor, pool, subset))


def _record(
    state: SamplerState,
    actor: Params,
    step: jax.Array,
    log_density: jax.Array,
    ended: jax.Array,
    *,
    source: SampleSource,
    weights: SampleWeights,
) -> SamplerState:
    return SamplerState(
        source=source.record(state.source, step, ended),
        weights=weights.record(state.weights, actor, step, log_density),
    )


def _take(
    state: SamplerState,
    pool: Transition,
    subset: DemonstrationSubset,
    replay_state: ReplayState,
    exploration_state: Any,
    draws: SampleDraws,
    *,
    source: SampleSource,
    weights: SampleWeights,
) -> tuple[RewardBatch, RewardBatch]:
    demonstrations = source.demonstrations(pool, subset, draws.demonstrations)
    background = source.background(state.source, replay_state, draws.background)
    of_demonstrations = weights.demonstrations(
        state.weights, demonstrations, replay_state, exploration_state
    )
    of_background = weights.background(state.weights, background, replay_state, exploration_state)
    return (
        RewardBatch(demonstrations.transition, of_demonstrations, demonstrations.mask),
        RewardBatch(background.transition, of_background, background.mask),
    )
