"""Which law the samples of Algorithm 1 came from: uniform weights, or the log density to divide by.

An importance weight is 1 / density (`objectives`). The density is the one recorded when the action
was drawn, or that of a mixture of snapshots of the policy. The demonstrations' own law is not
known: a Gaussian fitted to them stands in for it, which is an approximation.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax import checks
from cmedirl_jax import networks as networks_lib
from cmedirl_jax.agents import densities
from cmedirl_jax.agents.densities import ConditionalGaussian
from cmedirl_jax.agents.exploration import Exploration
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.replay import ReplayState
from cmedirl_jax.irl.sample_sources import Samples, SampleSource
from cmedirl_jax.networks import ActorCritic
from cmedirl_jax.types import EnvSpec, Params, Transition

FITTED_PAIRS = 1024
"""Demonstrated pairs that the Gaussian is fitted to, drawn with replacement."""


class SampleWeights(NamedTuple):
    """The samples' log densities as pure functions of one seed.

    Attributes:
        init: `(key, actor, pool, subset) -> state`, what is kept beside the replay.
        record: `(state, actor, step, log_density) -> state`, after transition number `step` `[]`
            was added; `log_density` `[]` is that of its action.
        demonstrations: `(state, samples, replay_state, exploration_state) -> [B]`, log densities.
        background: likewise.
    """

    init: Callable[[jax.Array, Params, Transition, DemonstrationSubset], Any]
    record: Callable[[Any, Params, jax.Array, jax.Array], Any]
    demonstrations: Callable[[Any, Samples, ReplayState, Any], jax.Array]
    background: Callable[[Any, Samples, ReplayState, Any], jax.Array]


def uniform() -> SampleWeights:
    """All samples weigh the same."""
    return SampleWeights(
        init=lambda key, actor, pool, subset: None,
        record=lambda state, actor, step, log_density: None,
        demonstrations=_zeros,
        background=_zeros,
    )


def _zeros(state: None, samples: Samples, replay_state: Any, exploration_state: Any) -> jax.Array:
    del state, replay_state, exploration_state
    return jnp.zeros(samples.mask.shape[:1], jnp.float32)


class RecordedState(flax.struct.PyTreeNode):
    """What recorded densities need beside a replay of `C` transitions.

    Attributes:
        log_density: `[C]`, of each of the replay's actions when it was drawn.
        demonstrator: the demonstrations' fitted behaviour.
    """

    log_density: jax.Array
    demonstrator: ConditionalGaussian


def recorded(spec: EnvSpec, source: SampleSource, replay_capacity: int) -> SampleWeights:
    """The density that was recorded when the action was drawn; demonstrations have a fitted one."""
    return SampleWeights(
        init=functools.partial(_init_recorded, spec=spec, replay_capacity=replay_capacity),
        record=functools.partial(_record_density, replay_capacity=replay_capacity),
        demonstrations=functools.partial(_demonstrator_density, spec=spec, source=source),
        background=functools.partial(_recorded_density, source=source),
    )


def _init_recorded(
    key: jax.Array,
    actor: Params,
    pool: Transition,
    subset: DemonstrationSubset,
    *,
    spec: EnvSpec,
    replay_capacity: int,
) -> RecordedState:
    del actor
    return RecordedState(jnp.zeros((replay_capacity,), jnp.float32), _fit(key, spec, pool, subset))


def _record_density(
    state: RecordedState,
    actor: Params,
    step: jax.Array,
    log_density: jax.Array,
    *,
    replay_capacity: int,
) -> RecordedState:
    del actor
    kept, density = state.log_density, jnp.asarray(log_density, jnp.float32)
    return state.replace(log_density=kept.at[step % replay_capacity].set(density))


def _recorded_density(
    state: RecordedState,
    samples: Samples,
    replay_state: Any,
    exploration_state: Any,
    *,
    source: SampleSource,
) -> jax.Array:
    del replay_state, exploration_state
    return source.total(state.log_density[samples.rows], samples.mask)


class MixtureState(flax.struct.PyTreeNode):
    """What the mixture's density needs.

    Attributes:
        snapshots: actor parameters `[K, ...]`, the latest K of those taken every `period` steps.
        demonstrator: the demonstrations' fitted behaviour.
    """

    snapshots: Params
    demonstrator: ConditionalGaussian


class _Mixture(NamedTuple):
    """The static parts of `mixture`."""

    spec: EnvSpec
    networks: ActorCritic
    exploration: Exploration
    source: SampleSource
    snapshots: int
    period: int
    demonstrated: float


def mixture(
    spec: EnvSpec,
    networks: ActorCritic,
    exploration: Exploration,
    source: SampleSource,
    *,
    snapshots: int,
    period: int,
    append: bool,
) -> SampleWeights:
    """The density of a mixture of the behaviour policy's latest snapshots.

    Args:
        spec: the environment's.
        networks: whose actor behaves.
        exploration: how it behaves; each snapshot explores as at the step at which it was taken.
        source: of the samples. A trajectory is one policy's from end to end.
        snapshots: `K`, how many.
        period: environment steps from one snapshot to the next.
        append: whether the demonstrations join the samples; then half of the mixture is their
            fitted behaviour.

    Raises:
        ValueError: if `snapshots` or `period` is not positive.
        TypeError: if one of them is not an integer.
    """
    checks.sizes(snapshots=snapshots, snapshot_period=period)
    # As many demonstrations as samples of the background.
    share = 0.5 if append else 0.0
    parts = _Mixture(spec, networks, exploration, source, snapshots, period, share)
    density = functools.partial(_mixture_density, parts=parts)
    return SampleWeights(
        init=functools.partial(_init_mixture, parts=parts),
        record=functools.partial(_record_snapshot, parts=parts),
        demonstrations=density,
        background=density,
    )


def _init_mixture(
    key: jax.Array, actor: Params, pool: Transition, subset: DemonstrationSubset, *, parts: _Mixture
) -> MixtureState:
    snapshots = jax.tree.map(
        lambda leaf: jnp.zeros((parts.snapshots, *leaf.shape), leaf.dtype), actor
    )
    return MixtureState(snapshots, _fit(key, parts.spec, pool, subset))


def _record_snapshot(
    state: MixtureState, actor: Params, step: jax.Array, log_density: jax.Array, *, parts: _Mixture
) -> MixtureState:
    del log_density
    slot = step // parts.period % parts.snapshots
    due = step % parts.period == 0
    # One slot is written at every step: a branch would copy all of them.
    snapshots = jax.tree.map(
        lambda kept, leaf: kept.at[slot].set(jnp.where(due, leaf, kept[slot])),
        state.snapshots,
        actor,
    )
    return state.replace(snapshots=snapshots)


def _mixture_density(
    state: MixtureState,
    samples: Samples,
    replay_state: ReplayState,
    exploration_state: Any,
    *,
    parts: _Mixture,
) -> jax.Array:
    transition, source = samples.transition, parts.source

    def of_snapshot(actor: Params, step: jax.Array) -> jax.Array:
        greedy = networks_lib.policy(parts.networks, actor, transition.observation)
        return parts.exploration.log_density(exploration_state, greedy, transition.action, step)

    # The slots hold the latest snapshots, up to number `latest`; below 0 there is none yet.
    latest = (replay_state.count - 1) // parts.period
    number = latest - (latest - jnp.arange(parts.snapshots, dtype=jnp.int32)) % parts.snapshots
    each = jax.vmap(of_snapshot)(state.snapshots, number * parts.period)
    of_policies = source.mixture(each, samples.mask, number >= 0)
    of_demonstrator = _demonstrator_density(
        state, samples, replay_state, exploration_state, spec=parts.spec, source=source
    )
    return jnp.logaddexp(
        jnp.log(parts.demonstrated) + of_demonstrator, jnp.log1p(-parts.demonstrated) + of_policies
    )


def _demonstrator_density(
    state: RecordedState | MixtureState,
    samples: Samples,
    replay_state: Any,
    exploration_state: Any,
    *,
    spec: EnvSpec,
    source: SampleSource,
) -> jax.Array:
    del replay_state, exploration_state
    transition = samples.transition
    by_step = densities.gaussian_policy(
        spec, state.demonstrator, transition.observation, transition.action
    )
    return source.total(by_step, samples.mask)


def _fit(
    key: jax.Array, spec: EnvSpec, pool: Transition, subset: DemonstrationSubset
) -> ConditionalGaussian:
    index = demonstrations_lib.sample_index(key, subset, FITTED_PAIRS)
    pairs = demonstrations_lib.at(pool, index)
    return densities.fit_gaussian(spec, pairs.observation, pairs.action)
