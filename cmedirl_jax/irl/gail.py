"""Generative adversarial imitation learning behind the interface of a `RewardLearner`.

A comparator: Ho and Ermon 2016, off-policy as in Discriminator-Actor-Critic (Kostrikov et al.
2019). The discriminator D = sigmoid(f) tells demonstrations from background; the reward is a
function of D.
"""

from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import checks, optimizers
from cmedirl_jax.irl import base, regularisers, rewards
from cmedirl_jax.irl.base import RewardInfo, RewardLearner, RewardState
from cmedirl_jax.optimizers import traced
from cmedirl_jax.ranges import NotNegative, Positive
from cmedirl_jax.types import EnvSpec, Network, Params, RewardBatch, Transition


class GAILHParams(flax.struct.PyTreeNode):
    """Hyperparameters. The numbers are traced leaves of the state.

    Attributes:
        learning_rate: Adam's rate for the discriminator.
        scale: Factor on the reward.
        output_penalty: Weight of the mean squared f(s, a) against the log-likelihood.
        form: The reward: above zero, where living on pays; below zero, where ending does; or
            either.
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
        ValueError: if the specification does not agree with itself.
    """
    checks.env_spec(spec)
    hparams = hparams or GAILHParams()
    network = network or rewards.mlp(spec)
    tx = optax.with_extra_args_support(optimizer or optimizers.adam())

    def init(key: jax.Array) -> RewardState:
        params = network.init(key)
        return RewardState(params, tx.init(params), traced(hparams))

    def of_logit(logit: jax.Array, hparams: GAILHParams) -> jax.Array:
        match hparams.form:
            case "-log(1 - D)":
                return hparams.scale * jax.nn.softplus(logit)
            case "log D":
                return hparams.scale * jax.nn.log_sigmoid(logit)
            case "logit D":
                return hparams.scale * logit

    def reward(state: RewardState, observation: jax.Array, action: jax.Array) -> jax.Array:
        checks.pairs(spec, observation, action)
        return of_logit(network.apply(state.params, observation, action), state.hparams)

    def update(
        state: RewardState,
        demonstrations: Transition | RewardBatch,
        background: Transition | RewardBatch,
        *,
        key: jax.Array | None = None,
    ) -> tuple[RewardState, RewardInfo]:
        del key
        demonstrated, sampled = (
            base.pairs(spec, demonstrations, "demonstrations"),
            base.pairs(spec, background, "background"),
        )
        split = demonstrated.mask.shape

        def loss(params: Params):
            observation, action = (
                jnp.concatenate(
                    [getattr(batch.transition, name) for batch in (demonstrated, sampled)]
                )
                for name in ("observation", "action")
            )
            logit = network.apply(params, observation, action)
            on_demonstrations, on_background = jnp.split(logit, split)
            value = log_likelihood(
                (on_demonstrations, demonstrated.mask), (on_background, sampled.mask)
            )
            mask = jnp.concatenate([demonstrated.mask, sampled.mask])
            penalty = regularisers.output_penalty(logit, mask)
            penalised = -value + state.hparams.output_penalty * penalty
            return penalised, (value, on_demonstrations, on_background)

        gradient, (value, on_demonstrations, on_background) = jax.grad(loss, has_aux=True)(
            state.params
        )
        updates, optimizer_state = tx.update(
            gradient, state.optimizer, state.params, learning_rate=state.hparams.learning_rate
        )
        r_d, r_b = (of_logit(logit, state.hparams) for logit in (on_demonstrations, on_background))
        info = RewardInfo(
            demonstration_reward=regularisers.masked_mean(r_d, demonstrated.mask),
            background_reward=regularisers.masked_mean(r_b, sampled.mask),
            log_likelihood=value,
            log_prior=jnp.zeros(()),
            gradient_norm=optax.tree.norm(gradient),
            effective_sample_size=jnp.sum(sampled.mask).astype(value.dtype),
        )
        params = optax.apply_updates(state.params, updates)
        return state.replace(params=params, optimizer=optimizer_state), info

    return RewardLearner(init, reward, update)


def log_likelihood(
    demonstrations: tuple[jax.Array, jax.Array], background: tuple[jax.Array, jax.Array]
) -> jax.Array:
    """mean_D log D + mean_B log(1 - D), `[]` (Ho and Ermon 2016, Eq. 14, whose D is this 1 - D).

    Args:
        demonstrations: logits of D `[D]`, and their mask.
        background: logits `[B]`, and their mask.
    """
    (on_demonstrations, mask), (on_background, background_mask) = demonstrations, background
    told = regularisers.masked_mean(jax.nn.log_sigmoid(on_demonstrations), mask)
    return told + regularisers.masked_mean(jax.nn.log_sigmoid(-on_background), background_mask)
