"""Algorithm 1: gradient steps on a reward network from demonstrations and background samples.

learner = irl.make(env.spec)
state = learner.init(jax.random.key(0))
state, info = jax.jit(learner.update)(state, demonstrations, background)
"""

import functools
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, cast

import flax.struct
import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import checks, modes, normalisation, observation_statistics, optimizers, ranges
from cmedirl_jax.hyperparameters import traced
from cmedirl_jax.irl import base, objectives, regularisers, rewards
from cmedirl_jax.irl.base import RewardInfo, RewardLearner, RewardState
from cmedirl_jax.irl.objectives import OBJECTIVES, Likelihood, ObjectiveName
from cmedirl_jax.irl.regularisers import BoundKind, Gauge
from cmedirl_jax.ranges import POSITIVE, NotNegative, Share
from cmedirl_jax.types import EnvSpec, Network, Params, RewardBatch, Transition


class IRLHParams(flax.struct.PyTreeNode):
    """Hyperparameters. The numbers are traced leaves of the state.

    Attributes:
        learning_rate: Adam's rate for the reward network, per update.
        bound: Largest magnitude of r_D, before any gauge, in units of the environment's reward.
        output_penalty: Weight of the mean squared f(s, a), and of the absorbing state's f^2,
            against the log-likelihood; keeps the tanh from saturating.
        prior_precision: Precision lambda of the Gaussian prior, log P(theta) = -lambda/2
            ||theta||^2 (Eq. 4).
        gradient_penalty: Weight of the squared gradient of f at points between demonstrations and
            background, with inputs in half-widths of their ranges; None: no such term.
        gradient_penalty_target: Norm of that gradient which is not penalised (Gulrajani et al.
            2017: 1).
        gauge_rate: Share of the way that each update moves the gauge's offset towards that of its
            batch.
        discount: Discount of a trajectory's return, per environment step; only at 1 is its optimum
            that of `tabular.maxent`.
        weight_exponent: Exponent of importance weights (1: as they are, 0: uniform).
        weight_limit: Largest distance of an importance weight's logarithm from the samples' mean;
            None: no limit.
        objective: How E[mu] is estimated: from pairs (visitation, transition) or from whole
            trajectories; see `irl.objectives`.
        bounded_by: r_D = bound * tanh(f), f clipped to +-bound, or f itself.
        gauge: Constant subtracted from r_D: none, its mean over the background, or its maximum over
            the demonstrations.
        absorbing: Learn the reward of an absorbing state after termination (Kostrikov et al. 2019).
            With pairs it is one more sample after each termination; with trajectories it fills the
            steps up to the time limit.
        append_demonstrations: Append the demonstration batch to the background batch (Algorithm 1,
            line 4).
    """

    learning_rate: NotNegative = 1e-3
    bound: Annotated[
        float,
        POSITIVE._replace(
            words="positive and finite (for an unbounded reward take reward.bounded_by none)"
        ),
    ] = 0.1
    output_penalty: NotNegative = 0.05
    prior_precision: NotNegative = 0.0
    gradient_penalty: NotNegative | None = None
    gradient_penalty_target: NotNegative = 0.0
    gauge_rate: Share = 0.05
    discount: Share = 1.0
    weight_exponent: NotNegative = 1.0
    weight_limit: NotNegative | None = None
    objective: ObjectiveName = flax.struct.field(pytree_node=False, default="visitation")
    bounded_by: BoundKind = flax.struct.field(pytree_node=False, default="tanh")
    gauge: Gauge = flax.struct.field(pytree_node=False, default="none")
    absorbing: bool = flax.struct.field(pytree_node=False, default=False)
    append_demonstrations: bool = flax.struct.field(pytree_node=False, default=True)


class RewardParams(NamedTuple):
    """Parameters of r_D.

    Attributes:
        network: parameters of f.
        offset: `[]`, the gauge's constant, which is subtracted from the bounded f.
        absorbing: `[]`, f of the absorbing state; None without one.
    """

    network: Params
    offset: jax.Array
    absorbing: jax.Array | None


def make(
    spec: EnvSpec,
    hparams: IRLHParams | None = None,
    *,
    network: Network | None = None,
    optimizer: optax.GradientTransformation | None = None,
) -> RewardLearner:
    """Make the learner for an environment.

    Args:
        spec: the environment's sizes and bounds.
        hparams: the initial hyperparameters.
        network: f(s, a), default `rewards.mlp(spec)`.
        optimizer: default Adam at `state.hparams.learning_rate`. It is given the gradient of the
            *negative* posterior, to descend.

    Raises:
        ValueError: if the specification contradicts itself, a hyperparameter is out of range, or
            there is no such objective.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    checks.env_spec(spec)
    hparams = hparams or IRLHParams()
    ranges.check(hparams)
    trajectories = OBJECTIVES[hparams.objective].trajectories
    parts = _Parts(
        spec=spec,
        network=network or rewards.mlp(spec),
        optimizer=optax.with_extra_args_support(optimizer or optimizers.adam()),
        check=base.trajectories if trajectories else base.pairs,
    )
    return RewardLearner(
        init=functools.partial(_init, parts, hparams),
        reward=functools.partial(_reward, parts),
        update=functools.partial(_update, parts),
        absorbing=_absorbing if hparams.absorbing else None,
    )


class _Parts(NamedTuple):
    """What the functions of one learner share. All static."""

    spec: EnvSpec
    network: Network
    optimizer: optax.GradientTransformationExtraArgs
    check: Callable[[EnvSpec, Transition | RewardBatch, str], RewardBatch]


class _Steps(NamedTuple):
    """All steps of a batch: observations `[P, O]`, actions `[P, A]`, and which of them count."""

    observation: jax.Array
    action: jax.Array
    mask: jax.Array


class _Evaluation(NamedTuple):
    """What the posterior was made of; `r_d` is that of each batch's steps, without the gauge."""

    r_d: list[jax.Array]
    likelihood: Likelihood
    log_prior: jax.Array


def _init(parts: _Parts, hparams: IRLHParams, key: jax.Array) -> RewardState:
    absorbing = jnp.zeros((), jnp.float32) if hparams.absorbing else None
    params = RewardParams(parts.network.init(key), jnp.zeros((), jnp.float32), absorbing)
    state = RewardState(params, parts.optimizer.init(_learned(params)), traced(hparams))
    return modes.vary(state, key)


def _reward(
    parts: _Parts, state: RewardState, observation: jax.Array, action: jax.Array
) -> jax.Array:
    checks.pairs(parts.spec, observation, action)
    output = parts.network.apply(state.params.network, observation, action)
    return _bounded(output, state.hparams) - state.params.offset


def _absorbing(state: RewardState) -> jax.Array:
    return _bounded(state.params.absorbing, state.hparams) - state.params.offset


def _update(
    parts: _Parts,
    state: RewardState,
    demonstrations: Transition | RewardBatch,
    background: Transition | RewardBatch,
    *,
    key: jax.Array | None = None,
) -> tuple[RewardState, RewardInfo]:
    batches = (
        parts.check(parts.spec, demonstrations, "demonstrations"),
        parts.check(parts.spec, background, "background"),
    )
    steps = (_steps(batches[0]), _steps(batches[1]))

    # Descend the negative posterior (Algorithm 1, lines 5 and 6).
    hparams, learned = state.hparams, _learned(state.params)
    gradient, evaluation = jax.grad(_negative_posterior, has_aux=True)(
        learned, parts, hparams, batches, steps, key
    )
    updates, optimizer_state = parts.optimizer.update(
        gradient, state.optimizer, learned, learning_rate=hparams.learning_rate
    )

    # Diagnostics, of the state before; then the gauge.
    scored = [(r_d, of.mask) for r_d, of in zip(evaluation.r_d, steps, strict=True)]
    offset = state.params.offset
    info = RewardInfo(
        *(regularisers.masked_mean(*one) - offset for one in scored),
        log_likelihood=evaluation.likelihood.value,
        log_prior=evaluation.log_prior,
        gradient_norm=optax.tree.norm(gradient),
        effective_sample_size=evaluation.likelihood.effective_sample_size,
    )
    if hparams.gauge != "none":
        target = regularisers.gauge_offset(hparams.gauge, *scored)
        offset += (hparams.gauge_rate * (target - offset)).astype(offset.dtype)
    network, absorbing = cast(
        Any, optax.apply_updates(learned, observation_statistics.fixed(updates))
    )
    params = RewardParams(network, offset, absorbing)
    return state.replace(params=params, optimizer=optimizer_state), info


def _negative_posterior(
    learned: Any,
    parts: _Parts,
    hparams: IRLHParams,
    batches: tuple[RewardBatch, RewardBatch],
    steps: tuple[_Steps, _Steps],
    key: jax.Array | None,
) -> tuple[jax.Array, _Evaluation]:
    """-(log P(D | r_D) + log P(theta)) of Eq. 4 `[]`, with the penalties on f."""
    # f and r_D of both batches in one pass of the network.
    params, absorbed = learned
    both = _Steps(*map(jnp.concatenate, zip(*steps, strict=True)))
    output = parts.network.apply(params, both.observation, both.action)
    r_d = jnp.split(_bounded(output, hparams), steps[0].mask.shape)
    penalty = regularisers.output_penalty(output, both.mask)
    if absorbed is not None:
        penalty += jnp.square(absorbed)
        absorbed = _bounded(absorbed, hparams)

    # The two terms of the posterior, and the penalties.
    likelihood = log_likelihood(hparams, batches, r_d, absorbed)
    log_prior = regularisers.log_prior(learned, hparams.prior_precision)
    loss = hparams.output_penalty * penalty - (likelihood.value + log_prior)
    if hparams.gradient_penalty is not None:
        slope = _gradient_penalty(params, parts, hparams, steps, key)
        loss += hparams.gradient_penalty * slope
    return loss, _Evaluation(r_d, likelihood, log_prior)


def _gradient_penalty(
    params: Params,
    parts: _Parts,
    hparams: IRLHParams,
    steps: tuple[_Steps, _Steps],
    key: jax.Array | None,
) -> jax.Array:
    """The penalty `[]` on the gradient of f at points between demonstrations and background."""
    if key is None:
        raise ValueError("a gradient penalty draws the points it is taken at: pass a key")
    ends = [(of.observation, of.action) for of in steps]
    observation, action = regularisers.interpolate(key, ends[0], ends[1])
    size = observation.shape[0]
    return regularisers.gradient_penalty(
        lambda observation, action: parts.network.apply(params, observation, action),
        observation,
        action,
        steps[0].mask[:size] & steps[1].mask[:size],
        scale=(
            normalisation.units(parts.spec, params),
            jnp.asarray(0.5 * (parts.spec.action_high - parts.spec.action_low)),
        ),
        target=hparams.gradient_penalty_target,
    )


def log_likelihood(
    hparams: IRLHParams,
    batches: tuple[RewardBatch, RewardBatch],
    r_d: list[jax.Array],
    absorbed: jax.Array | None,
) -> Likelihood:
    """L_D by the objective that `hparams` name.

    Args:
        hparams: the hyperparameters.
        batches: demonstrations and background.
        r_d: r_D of each batch's steps, `[B]`, or `[M * T]` for trajectories.
        absorbed: `[]`, r_D of the absorbing state; None without one.

    Raises:
        ValueError: if there is no such objective.
    """
    objective, append = OBJECTIVES[hparams.objective], hparams.append_demonstrations
    demonstrations, background = objectives.weighed(
        *(
            objective.score(batch, reward, absorbed, hparams.discount)
            for batch, reward in zip(batches, r_d, strict=True)
        ),
        append=append,
        exponent=hparams.weight_exponent,
        limit=hparams.weight_limit,
    )
    return objective.likelihood(demonstrations, background, append=append)


def _learned(params: RewardParams) -> Any:
    """The parameters that the optimiser moves; the gauge's offset follows its batches instead."""
    return params.network, params.absorbing


def _bounded(output: jax.Array, hparams: IRLHParams) -> jax.Array:
    return regularisers.bounded(output, hparams.bound, hparams.bounded_by)


def _steps(batch: RewardBatch) -> _Steps:
    observation, action = batch.transition.observation, batch.transition.action
    return _Steps(
        observation.reshape(-1, observation.shape[-1]),
        action.reshape(-1, action.shape[-1]),
        batch.mask.reshape(-1),
    )
