"""Generative adversarial imitation learning behind the interface of a `RewardLearner`.

A comparator: Ho and Ermon 2016, off-policy as in Discriminator-Actor-Critic (Kostrikov et al.
2019). The discriminator D = sigmoid(f) tells demonstrations from background; the reward is a
function of D.
"""

import functools
from typing import Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import checks, observation_statistics, optimizers, ranges
from cmedirl_jax.hyperparameters import traced
from cmedirl_jax.irl import base, regularisers, rewards
from cmedirl_jax.irl.base import RewardInfo, RewardLearner, RewardState
from cmedirl_jax.ranges import NotNegative, Positive
from cmedirl_jax.types import EnvSpec, Network, Params, RewardBatch, Transition


class GAILHParams(flax.struct.PyTreeNode):
    """Hyperparameters. The numbers are traced leaves of the state.

    Attributes:
        learning_rate: Adam's rate for the discriminator, per update.
        scale: Factor on the reward.
        output_penalty: Weight of the mean squared f(s, a) against the log-likelihood.
        form: The reward as a function of D: -log(1 - D) is positive, so that longer episodes earn
            more; log D is negative, so that shorter ones do; logit D can be either.
    """

    learning_rate: NotNegative = 1e-3
    scale: Positive = 0.1
    output_penalty: NotNegative = 0.05
    form: Literal["-log(1 - D)", "log D", "logit D"] = flax.struct.field(
        pytree_node=False, default="-log(1 - D)"
    )


def make(
    spec: EnvSpec,
    hparams: GAILHParams | None = None,
    *,
    network: Network | None = None,
    optimizer: optax.GradientTransformation | None = None,
) -> RewardLearner:
    """Make the learner for an environment; its parameters are the network's.

    Args:
        spec: the environment's sizes and bounds.
        hparams: the initial hyperparameters.
        network: f(s, a), the discriminator's logit, default `rewards.mlp(spec)`.
        optimizer: default Adam at `state.hparams.learning_rate`.

    Raises:
        ValueError: if the specification contradicts itself, or a hyperparameter is out of range.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    checks.env_spec(spec)
    hparams = hparams or GAILHParams()
    ranges.check(hparams)
    parts = _Parts(
        spec=spec,
        network=network or rewards.mlp(spec),
        optimizer=optax.with_extra_args_support(optimizer or optimizers.adam()),
    )
    return RewardLearner(
        init=functools.partial(_init, parts, hparams),
        reward=functools.partial(_reward, parts),
        update=functools.partial(_update, parts),
    )


class _Parts(NamedTuple):
    """What the functions of one learner share. All static."""

    spec: EnvSpec
    network: Network
    optimizer: optax.GradientTransformationExtraArgs


class _Evaluation(NamedTuple):
    """Log-likelihood `[]`, and logits of the demonstrations `[D]` and of the background `[B]`."""

    log_likelihood: jax.Array
    demonstrations: jax.Array
    background: jax.Array


def _init(parts: _Parts, hparams: GAILHParams, key: jax.Array) -> RewardState:
    params = parts.network.init(key)
    return RewardState(params, parts.optimizer.init(params), traced(hparams))


def _reward(
    parts: _Parts, state: RewardState, observation: jax.Array, action: jax.Array
) -> jax.Array:
    checks.pairs(parts.spec, observation, action)
    return _of_logit(parts.network.apply(state.params, observation, action), state.hparams)


def _of_logit(logit: jax.Array, hparams: GAILHParams) -> jax.Array:
    """The reward of the discriminator's logit, `[...]` -> `[...]`."""
    match hparams.form:
        case "-log(1 - D)":
            return hparams.scale * jax.nn.softplus(logit)
        case "log D":
            return hparams.scale * jax.nn.log_sigmoid(logit)
        case "logit D":
            return hparams.scale * logit


def _update(
    parts: _Parts,
    state: RewardState,
    demonstrations: Transition | RewardBatch,
    background: Transition | RewardBatch,
    *,
    key: jax.Array | None = None,
) -> tuple[RewardState, RewardInfo]:
    del key
    demonstrated = base.pairs(parts.spec, demonstrations, "demonstrations")
    sampled = base.pairs(parts.spec, background, "background")

    # Train the discriminator.
    gradient, evaluation = jax.grad(_loss, has_aux=True)(
        state.params, parts, state.hparams, demonstrated, sampled
    )
    updates, optimizer_state = parts.optimizer.update(
        gradient, state.optimizer, state.params, learning_rate=state.hparams.learning_rate
    )
    params = optax.apply_updates(state.params, observation_statistics.fixed(updates))

    # Diagnostics, of the state before.
    r_d = _of_logit(evaluation.demonstrations, state.hparams)
    r_b = _of_logit(evaluation.background, state.hparams)
    info = RewardInfo(
        demonstration_reward=regularisers.masked_mean(r_d, demonstrated.mask),
        background_reward=regularisers.masked_mean(r_b, sampled.mask),
        log_likelihood=evaluation.log_likelihood,
        log_prior=jnp.zeros((), jnp.float32),
        gradient_norm=optax.tree.norm(gradient),
        effective_sample_size=jnp.sum(sampled.mask).astype(evaluation.log_likelihood.dtype),
    )
    return state.replace(params=params, optimizer=optimizer_state), info


def _loss(
    params: Params,
    parts: _Parts,
    hparams: GAILHParams,
    demonstrated: RewardBatch,
    sampled: RewardBatch,
) -> tuple[jax.Array, _Evaluation]:
    """The discriminator's negative log-likelihood `[]`, with the penalty on its logit."""
    # Both batches in one pass of the network.
    pairs = [
        (batch.transition.observation, batch.transition.action) for batch in (demonstrated, sampled)
    ]
    observation, action = map(jnp.concatenate, zip(*pairs, strict=True))
    logit = parts.network.apply(params, observation, action)
    on_demonstrations, on_background = jnp.split(logit, demonstrated.mask.shape)

    value = log_likelihood((on_demonstrations, demonstrated.mask), (on_background, sampled.mask))
    mask = jnp.concatenate([demonstrated.mask, sampled.mask])
    loss = -value + hparams.output_penalty * regularisers.output_penalty(logit, mask)
    return loss, _Evaluation(value, on_demonstrations, on_background)


def log_likelihood(
    demonstrations: tuple[jax.Array, jax.Array], background: tuple[jax.Array, jax.Array]
) -> jax.Array:
    """mean_D log D + mean_B log(1 - D), `[]` (Ho and Ermon 2016, Eq. 14, with 1 - D as their D).

    Args:
        demonstrations: logits of D `[D]`, and their mask.
        background: logits of D `[B]`, and their mask.
    """
    (on_demonstrations, mask), (on_background, background_mask) = demonstrations, background
    of_demonstrations = regularisers.masked_mean(jax.nn.log_sigmoid(on_demonstrations), mask)
    return of_demonstrations + regularisers.masked_mean(
        jax.nn.log_sigmoid(-on_background), background_mask
    )
