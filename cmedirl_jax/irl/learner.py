"""Algorithm 1: gradient steps on a reward network from demonstrations and background samples.

learner = irl.make(env.spec)
state = learner.init(jax.random.key(0))
state, info = jax.jit(learner.update)(state, demonstrations, background)
"""

from typing import Annotated, Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from cmedirl_jax import checks, optimizers
from cmedirl_jax.irl import base, objectives, regularisers, rewards
from cmedirl_jax.irl.base import RewardInfo, RewardLearner, RewardState
from cmedirl_jax.irl.objectives import OBJECTIVES, Likelihood, ObjectiveName
from cmedirl_jax.irl.regularisers import BoundKind, Gauge
from cmedirl_jax.optimizers import traced
from cmedirl_jax.ranges import POSITIVE, NotNegative, Share
from cmedirl_jax.types import EnvSpec, Network, Params, RewardBatch, Transition


class IRLHParams(flax.struct.PyTreeNode):
    """Hyperparameters. The numbers are traced leaves of the state.

    Attributes:
        learning_rate: Adam's rate for the reward network.
        bound: Largest magnitude of r_D, before any gauge.
        output_penalty: Weight of the mean squared f(s, a) against the log-likelihood, and of the
            absorbing state's f^2; keeps tanh off its ends.
        prior_precision: Precision lambda of the Gaussian prior, log P(theta) = -lambda/2
            ||theta||^2 (Eq. 4).
        gradient_penalty: Weight of the squared gradient of f at points between demonstrations and
            background, by inputs in half-widths of their ranges; None: no such term, nor its cost.
        gradient_penalty_target: Norm of the gradient that is not penalised (Gulrajani et al. 2017:
            1).
        gauge_rate: Share of the gauge's offset that each update moves to that of its batch.
        discount: Discount of a trajectory's return; only 1 makes its optimum that of
            `tabular.maxent`.
        weight_exponent: Exponent of importance weights: 1 as they are, 0 uniform.
        weight_limit: Largest distance of an importance weight's logarithm from the samples' mean;
            None: any.
        objective: How E[mu] is estimated, see `irl.objectives`; the last takes trajectories.
        bounded_by: r_D = bound * tanh(f), f clipped to +-bound, or f itself.
        gauge: Constant taken off r_D: none, its background mean, or the demonstrations' largest.
        absorbing: Learn the reward of an absorbing state after termination (Kostrikov et al. 2019).
            Of pairs, one more sample follows each termination; of trajectories, the rest of the
            time limit.
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
        network: of f.
        offset: `[]`, the gauge's constant, which r_D lies below f's bounded value by.
        absorbing: `[]`, f of the absorbing state; None where there is none.
    """

    network: Params
    offset: jax.Array
    absorbing: jax.Array | None


class _Steps(NamedTuple):
    """All steps of a batch: observations `[P, O]`, actions `[P, A]`, and which of them count."""

    observation: jax.Array
    action: jax.Array
    mask: jax.Array


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
        optimizer: default Adam at `state.hparams.learning_rate`; it is handed the gradient of the
            *negative* posterior, to descend.

    Raises:
        ValueError: if the specification does not agree with itself, or there is no such objective.
    """
    checks.env_spec(spec)
    hparams = hparams or IRLHParams()
    network = network or rewards.mlp(spec)
    tx = optax.with_extra_args_support(optimizer or optimizers.adam())
    trajectories = OBJECTIVES[hparams.objective].trajectories
    checked = base.trajectories if trajectories else base.pairs
    units = _units(spec)

    def init(key: jax.Array) -> RewardState:
        absorbing = jnp.zeros(()) if hparams.absorbing else None
        params = RewardParams(network.init(key), jnp.zeros(()), absorbing)
        learned: Any = (params.network, params.absorbing)
        return RewardState(params, tx.init(learned), traced(hparams))

    def bounded(output: jax.Array, hparams: IRLHParams) -> jax.Array:
        return regularisers.bounded(output, hparams.bound, hparams.bounded_by)

    def reward(state: RewardState, observation: jax.Array, action: jax.Array) -> jax.Array:
        checks.pairs(spec, observation, action)
        output = network.apply(state.params.network, observation, action)
        return bounded(output, state.hparams) - state.params.offset

    def absorbing(state: RewardState) -> jax.Array:
        return bounded(state.params.absorbing, state.hparams) - state.params.offset

    def slope(
        params: Params, steps: tuple[_Steps, ...], hparams: IRLHParams, key: jax.Array | None
    ) -> jax.Array:
        if key is None:
            raise ValueError("a gradient penalty draws the points it is taken at: pass a key")
        ends = [(of.observation, of.action) for of in steps]
        observation, action = regularisers.interpolate(key, ends[0], ends[1])
        size = observation.shape[0]
        return regularisers.gradient_penalty(
            lambda observation, action: network.apply(params, observation, action),
            observation,
            action,
            steps[0].mask[:size] & steps[1].mask[:size],
            scale=units,
            target=hparams.gradient_penalty_target,
        )

    def update(
        state: RewardState,
        demonstrations: Transition | RewardBatch,
        background: Transition | RewardBatch,
        *,
        key: jax.Array | None = None,
    ) -> tuple[RewardState, RewardInfo]:
        batches = (
            checked(spec, demonstrations, "demonstrations"),
            checked(spec, background, "background"),
        )
        steps = tuple(_steps(batch) for batch in batches)
        every = _Steps(*map(jnp.concatenate, zip(*steps, strict=True)))

        def negative_posterior(learned: Any):
            params, absorbed = learned
            output = network.apply(params, every.observation, every.action)
            found = jnp.split(bounded(output, state.hparams), steps[0].mask.shape)
            penalty = regularisers.output_penalty(output, every.mask)
            if absorbed is not None:
                penalty += jnp.square(absorbed)
                absorbed = bounded(absorbed, state.hparams)
            likelihood = log_likelihood(state.hparams, batches, found, absorbed)
            log_prior = regularisers.log_prior(learned, state.hparams.prior_precision)
            loss = state.hparams.output_penalty * penalty - (likelihood.value + log_prior)
            if state.hparams.gradient_penalty is not None:
                loss += state.hparams.gradient_penalty * slope(params, steps, state.hparams, key)
            return loss, (found, likelihood, log_prior)

        learned: Any = (state.params.network, state.params.absorbing)
        gradient, (found, likelihood, log_prior) = jax.grad(negative_posterior, has_aux=True)(
            learned
        )
        updates, optimizer_state = tx.update(
            gradient, state.optimizer, learned, learning_rate=state.hparams.learning_rate
        )
        scored = [(r_d, of.mask) for r_d, of in zip(found, steps, strict=True)]
        offset = state.params.offset
        info = RewardInfo(
            *(regularisers.masked_mean(*one) - offset for one in scored),
            log_likelihood=likelihood.value,
            log_prior=log_prior,
            gradient_norm=optax.tree.norm(gradient),
            effective_sample_size=likelihood.effective_sample_size,
        )
        if state.hparams.gauge != "none":
            target = regularisers.gauge_offset(state.hparams.gauge, *scored)
            offset = offset + state.hparams.gauge_rate * (target - offset)
        moved: Any = optax.apply_updates(learned, updates)
        params = RewardParams(moved[0], offset, moved[1])
        return state.replace(params=params, optimizer=optimizer_state), info

    return RewardLearner(init, reward, update, absorbing if hparams.absorbing else None)


def log_likelihood(
    hparams: IRLHParams,
    batches: tuple[RewardBatch, RewardBatch],
    found: list[jax.Array],
    absorbed: jax.Array | None,
) -> Likelihood:
    """L_D by the objective that `hparams` name.

    Args:
        hparams: the hyperparameters.
        batches: demonstrations and background.
        found: r_D of each batch's pairs, `[B]`, or `[M * T]` for trajectories.
        absorbed: `[]`, r_D of the absorbing state, or None without one.
    """
    objective, append = OBJECTIVES[hparams.objective], hparams.append_demonstrations
    demonstrations, background = objectives.weighed(
        *(
            objective.score(batch, r_d, absorbed, hparams.discount)
            for batch, r_d in zip(batches, found, strict=True)
        ),
        append=append,
        exponent=hparams.weight_exponent,
        limit=hparams.weight_limit,
    )
    return objective.likelihood(demonstrations, background, append=append)


def _steps(batch: RewardBatch) -> _Steps:
    observation, action = batch.transition.observation, batch.transition.action
    return _Steps(
        observation.reshape(-1, observation.shape[-1]),
        action.reshape(-1, action.shape[-1]),
        batch.mask.reshape(-1),
    )


def _units(spec: EnvSpec) -> tuple[jax.Array, jax.Array]:
    """Half-widths of the ranges of observations and actions; 1 where a range is infinite."""
    low = (spec.observation_low, spec.action_low)
    high = (spec.observation_high, spec.action_high)
    widths = [0.5 * (above - below) for below, above in zip(low, high, strict=True)]
    return tuple(jnp.asarray(np.where(np.isfinite(width), width, 1.0)) for width in widths)  # type: ignore[return-value]
