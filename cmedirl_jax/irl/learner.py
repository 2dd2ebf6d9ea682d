"""Algorithm 1: gradient steps on a reward network from demonstrations and background samples.

learner = irl.make(env.spec)
state = learner.init(jax.random.key(0))
state, info = jax.jit(learner.update)(state, demonstrations, background)
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import optimizers, rewards
from cmedirl_jax.irl import objectives
from cmedirl_jax.types import EnvSpec, Network, Params, Transition


class IRLHParams(flax.struct.PyTreeNode):
    """Hyperparameters. The numbers are traced leaves of the state."""

    learning_rate: float = 1e-3
    """Adam's rate for the reward network."""
    bound: float = 0.1
    """r_D = bound * tanh(f(s, a)); inf for r_D = f(s, a)."""
    output_penalty: float = 0.05
    """Weight of the mean squared f(s, a) against the log-likelihood; keeps tanh off its ends."""
    prior_precision: float = 0.0
    """Precision lambda of the Gaussian prior, log P(theta) = -lambda/2 ||theta||^2 (Eq. 4)."""
    append_demonstrations: bool = flax.struct.field(pytree_node=False, default=True)
    """Append the demonstration batch to the background batch (Algorithm 1, line 4)."""


class RewardState(flax.struct.PyTreeNode):
    """The reward network's parameters, its optimiser and the hyperparameters."""

    params: Params
    optimizer: optax.OptState
    hparams: IRLHParams


class RewardInfo(NamedTuple):
    """Diagnostics of one update, all `[]`, of the state before it.

    Attributes:
        demonstration_reward: mean r_D over the demonstration batch.
        background_reward: mean r_D over the background batch, without appended demonstrations.
        log_prior: log P(theta) up to its constant.
        gradient_norm: global norm of dL/dtheta (Eq. 5), penalties included.
    """

    demonstration_reward: jax.Array
    background_reward: jax.Array
    log_prior: jax.Array
    gradient_norm: jax.Array


class UpdateFn(Protocol):
    """One iteration of Algorithm 1, lines 4-6."""

    def __call__(
        self,
        state: RewardState,
        demonstrations: Transition,
        background: Transition,
        *,
        key: jax.Array | None = None,
    ) -> tuple[RewardState, RewardInfo]:
        """Take a step along the sampled estimate of dL/dtheta, L = log P(D | r) + log P(theta).

        Args:
            state: the state before.
            demonstrations: the demonstration batch, leaves `[D, ...]`.
            background: the background batch, leaves `[B, ...]`.
            key: for learners that draw; this one does not.

        Raises:
            ValueError: if a batch's observations or actions are not `[., O]` and `[., A]`.
        """
        ...


class RewardLearner(NamedTuple):
    """A learner of rewards as pure functions.

    Attributes:
        init: `(key) -> RewardState`.
        reward: `(state, observation [..., O], action [..., A]) -> [...]`, r_D(s, a; theta).
        update: see `UpdateFn`.
    """

    init: Callable[[jax.Array], RewardState]
    reward: Callable[[RewardState, jax.Array, jax.Array], jax.Array]
    update: UpdateFn


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
    """
    hparams = hparams or IRLHParams()
    network = network or rewards.mlp(spec)
    tx = optax.with_extra_args_support(optimizer or optimizers.adam())

    def init(key: jax.Array) -> RewardState:
        params = network.init(key)
        traced = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)
        return RewardState(params, tx.init(params), traced)

    def reward(state: RewardState, observation: jax.Array, action: jax.Array) -> jax.Array:
        return rewards.bounded(
            network.apply(state.params, observation, action), state.hparams.bound
        )

    def update(
        state: RewardState,
        demonstrations: Transition,
        background: Transition,
        *,
        key: jax.Array | None = None,
    ) -> tuple[RewardState, RewardInfo]:
        del key
        _check_pairs(spec, demonstrations, "demonstrations")
        _check_pairs(spec, background, "background")
        n_demonstrations = demonstrations.action.shape[0]
        n_background = background.action.shape[0]
        observation = jnp.concatenate([demonstrations.observation, background.observation])
        action = jnp.concatenate([demonstrations.action, background.action])

        output, vjp = jax.vjp(
            lambda params: network.apply(params, observation, action), state.params
        )
        r_d, bound_vjp = jax.vjp(lambda f: rewards.bounded(f, state.hparams.bound), output)
        difference = jnp.concatenate(
            objectives.visitation_difference(
                n_demonstrations, n_background, append=state.hparams.append_demonstrations
            )
        )
        penalty = 2.0 * state.hparams.output_penalty * output / output.size
        # Eqs. 5, 6 and 9 with a loss's sign: the difference in visitation is the error signal.
        (likelihood_gradient,) = vjp(penalty - bound_vjp(difference)[0])
        gradient = jax.tree.map(
            lambda data, theta: data + state.hparams.prior_precision * theta,
            likelihood_gradient,
            state.params,
        )
        updates, optimizer_state = tx.update(
            gradient, state.optimizer, state.params, learning_rate=state.hparams.learning_rate
        )
        info = RewardInfo(
            demonstration_reward=jnp.mean(r_d[:n_demonstrations]),
            background_reward=jnp.mean(r_d[n_demonstrations:]),
            log_prior=-0.5
            * state.hparams.prior_precision
            * optax.tree.norm(state.params, squared=True),
            gradient_norm=optax.tree.norm(gradient),
        )
        state = state.replace(
            params=optax.apply_updates(state.params, updates), optimizer=optimizer_state
        )
        return state, info

    return RewardLearner(init, reward, update)


def _check_pairs(spec: EnvSpec, batch: Transition, name: str) -> None:
    size = batch.observation.shape[:1]
    if (
        not size
        or batch.observation.shape != (*size, spec.observation_dim)
        or batch.action.shape != (*size, spec.action_dim)
    ):
        raise ValueError(
            f"{name}: expected observations [B, {spec.observation_dim}] and actions "
            f"[B, {spec.action_dim}], got {batch.observation.shape} and {batch.action.shape}"
        )
