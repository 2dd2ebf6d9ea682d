"""Deep deterministic policy gradient (Lillicrap et al. 2015), as the paper's Algorithm 2 uses it.

agent = ddpg.make(env.spec)
state = agent.init(jax.random.key(0))
state, info = jax.jit(agent.update)(state, batch)
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import checks, optimizers
from cmedirl_jax import networks as networks_lib
from cmedirl_jax.networks import ActorCritic
from cmedirl_jax.optimizers import traced
from cmedirl_jax.ranges import NotNegative, Positive, PositiveShare, Share
from cmedirl_jax.types import EnvSpec, Numeric, Params, Transition


class DDPGHParams(flax.struct.PyTreeNode):
    """Hyperparameters. The numbers are traced leaves of the state, to vmap over or to change.

    Attributes:
        discount: Discount of the return, gamma.
        tau: Share of the online parameters in each target update; 1 copies them.
        actor_learning_rate: Adam's rate for the actor.
        critic_learning_rate: Adam's rate for the critic.
        reward_scale: Factor on every reward the critic learns from.
        pre_activation_penalty: Weight of the mean squared pre-activation in the actor's loss; keeps
            tanh off its ends.
        behaviour_cloning: Weight of the actor's squared error on the demonstrations passed to
            `update`; the `tuned` preset sets 1.
        q_filter: Clone only the actions that the critic values above the actor's own (Nair et al.
            2018).
        bootstrap_at_termination: Leave (1 - terminated) out of the target, as Algorithm 2 is
            printed.
    """

    discount: Share = 0.99
    tau: PositiveShare = 0.01
    actor_learning_rate: NotNegative = 1e-4
    critic_learning_rate: NotNegative = 1e-3
    reward_scale: Positive = 1.0
    pre_activation_penalty: NotNegative = 1e-3
    behaviour_cloning: NotNegative = 0.0
    q_filter: bool = flax.struct.field(pytree_node=False, default=False)
    bootstrap_at_termination: bool = flax.struct.field(pytree_node=False, default=False)


class DDPGState(flax.struct.PyTreeNode):
    """Everything that `update` changes, and the hyperparameters it reads."""

    actor: Params
    critic: Params
    target_actor: Params
    target_critic: Params
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    hparams: DDPGHParams


class DDPGInfo(NamedTuple):
    """Diagnostics of one update, all `[]`.

    Attributes:
        critic_loss: mean squared temporal-difference error.
        q_mean: mean of Q(s, a) over the batch, before the update.
        actor_loss: -Q(s, mu(s)) with its penalties; 0 where the actor was not updated.
    """

    critic_loss: jax.Array
    q_mean: jax.Array
    actor_loss: jax.Array


class InitFn(Protocol):
    """Make a state."""

    def __call__(self, key: jax.Array, params: tuple[Params, Params] | None = None) -> DDPGState:
        """Draw `(actor, critic)` parameters, or take `params`; the targets are copies of them."""
        ...


class UpdateFn(Protocol):
    """One gradient step of critic and actor, then of the targets."""

    def __call__(
        self,
        state: DDPGState,
        batch: Transition,
        demonstrations: Transition | None = None,
        *,
        update_actor: Numeric = True,
        update_targets: Numeric = True,
        clone: Numeric = True,
    ) -> tuple[DDPGState, DDPGInfo]:
        """Update on `batch`, leaves `[B, ...]`, whose rewards are those to learn from.

        Args:
            state: the state before.
            batch: transitions.
            demonstrations: `[D, ...]` for the behaviour-cloning term, or None to leave it out.
            update_actor: bool, or a scalar predicate that must not be batched under vmap.
            update_targets: likewise; "every 300 steps" is a predicate and tau = 1.
            clone: likewise; add the behaviour-cloning term, where there are demonstrations.

        Raises:
            ValueError: if the batch's shapes are not `[B, O]`, `[B, A]` and `[B]`.
            TypeError: if its leaves are not floats, and `terminated` bool.
        """
        ...


class DDPG(NamedTuple):
    """The algorithm as pure functions.

    Attributes:
        networks: the actor, the critic and the squashing.
        init: see `InitFn`.
        act: `(state, observation [..., O]) -> action [..., A]`, mu(s), without noise.
        value: `(state, observation [..., O], action [..., A]) -> [...]`, Q(s, a).
        update: see `UpdateFn`.

    While tracing they raise ValueError for other shapes and TypeError for other dtypes.
    """

    networks: ActorCritic
    init: InitFn
    act: Callable[[DDPGState, jax.Array], jax.Array]
    value: Callable[[DDPGState, jax.Array, jax.Array], jax.Array]
    update: UpdateFn


def make(
    spec: EnvSpec,
    hparams: DDPGHParams | None = None,
    *,
    networks: ActorCritic | None = None,
    actor_optimizer: optax.GradientTransformation | None = None,
    critic_optimizer: optax.GradientTransformation | None = None,
) -> DDPG:
    """Make the algorithm for an environment.

    Args:
        spec: the environment's sizes and bounds.
        hparams: the initial hyperparameters.
        networks: default `networks.make(spec)`.
        actor_optimizer: default Adam at `state.hparams.actor_learning_rate`. Any other optax
            transformation holds its own rate, or reads `learning_rate=` as an extra argument.
        critic_optimizer: likewise.

    Raises:
        ValueError: if the specification does not agree with itself.
    """
    checks.env_spec(spec)
    hparams = hparams or DDPGHParams()
    networks = networks or networks_lib.make(spec)
    actor_tx = optax.with_extra_args_support(actor_optimizer or optimizers.adam())
    critic_tx = optax.with_extra_args_support(critic_optimizer or optimizers.adam())

    def init(key: jax.Array, params: tuple[Params, Params] | None = None) -> DDPGState:
        if params is None:
            actor_key, critic_key = jax.random.split(key)
            params = networks.actor.init(actor_key), networks.critic.init(critic_key)
        actor, critic = params
        return DDPGState(
            actor=actor,
            critic=critic,
            # Copies: a donated state must not hold the same buffer twice.
            target_actor=jax.tree.map(jnp.copy, actor),
            target_critic=jax.tree.map(jnp.copy, critic),
            actor_optimizer=actor_tx.init(actor),
            critic_optimizer=critic_tx.init(critic),
            hparams=traced(hparams),
        )

    def act(state: DDPGState, observation: jax.Array) -> jax.Array:
        checks.pairs(spec, observation)
        return networks_lib.policy(networks, state.actor, observation)

    def value(state: DDPGState, observation: jax.Array, action: jax.Array) -> jax.Array:
        checks.pairs(spec, observation, action)
        return networks.critic.apply(state.critic, observation, action)

    def update_critic(state: DDPGState, batch: Transition):
        targets = td_targets(networks, state, batch)
        (loss, (q, critic)), grads = jax.value_and_grad(critic_loss, argnums=1, has_aux=True)(
            networks, state.critic, batch, targets
        )
        updates, optimizer = critic_tx.update(
            grads, state.critic_optimizer, critic, learning_rate=state.hparams.critic_learning_rate
        )
        state = state.replace(
            critic=optax.apply_updates(critic, updates), critic_optimizer=optimizer
        )
        return state, loss, jnp.mean(q)

    def update_actor_params(
        state: DDPGState, batch: Transition, demonstrations: Transition | None, clone: Numeric
    ):
        (loss, actor), grads = jax.value_and_grad(actor_loss, argnums=1, has_aux=True)(
            networks, state.actor, state.critic, state.hparams, batch
        )
        if demonstrations is not None:
            # Apart from the loss above, so that a term that has faded out costs nothing.
            cloning_loss, cloning_grads = _when(
                clone,
                lambda actor: jax.value_and_grad(behaviour_cloning_loss, argnums=1)(
                    networks, actor, state.critic, state.hparams, demonstrations
                ),
                lambda actor: (jnp.zeros(()), jax.tree.map(jnp.zeros_like, actor)),
                actor,
            )
            loss, grads = jax.tree.map(jnp.add, (loss, grads), (cloning_loss, cloning_grads))
        updates, optimizer = actor_tx.update(
            grads, state.actor_optimizer, actor, learning_rate=state.hparams.actor_learning_rate
        )
        actor = optax.apply_updates(actor, updates)
        return state.replace(actor=actor, actor_optimizer=optimizer), loss

    def move_targets(state: DDPGState) -> DDPGState:
        def move(params: Params, target: Params) -> Params:
            return optax.incremental_update(params, target, state.hparams.tau)

        return state.replace(
            target_actor=move(state.actor, state.target_actor),
            target_critic=move(state.critic, state.target_critic),
        )

    def update(
        state: DDPGState,
        batch: Transition,
        demonstrations: Transition | None = None,
        *,
        update_actor: Numeric = True,
        update_targets: Numeric = True,
        clone: Numeric = True,
    ) -> tuple[DDPGState, DDPGInfo]:
        checks.transition_shapes(spec, batch, jnp.shape(batch.observation)[:1], "batch")
        if demonstrations is not None:
            leading = jnp.shape(demonstrations.observation)[:1]
            checks.transition_shapes(spec, demonstrations, leading, "demonstrations")
        state, critic_loss_value, q_mean = update_critic(state, batch)
        state, actor_loss_value = _when(
            update_actor,
            lambda state: update_actor_params(state, batch, demonstrations, clone),
            lambda state: (state, jnp.zeros(())),
            state,
        )
        state = _when(update_targets, move_targets, lambda state: state, state)
        return state, DDPGInfo(critic_loss_value, q_mean, actor_loss_value)

    return DDPG(networks, init, act, value, update)


def td_targets(networks: ActorCritic, state: DDPGState, batch: Transition) -> jax.Array:
    """y = r + gamma (1 - terminated) Q'(s', mu'(s')), `[B]` (Algorithm 2; the mask is DDPG's)."""
    next_action = networks_lib.policy(networks, state.target_actor, batch.next_observation)
    next_value = networks.critic.apply(state.target_critic, batch.next_observation, next_action)
    if not state.hparams.bootstrap_at_termination:
        next_value = jnp.where(batch.terminated, 0.0, next_value)
    return state.hparams.reward_scale * batch.reward + state.hparams.discount * next_value


def critic_loss(
    networks: ActorCritic, critic: Params, batch: Transition, targets: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, Params]]:
    """L = 1/B sum_i (y_i - Q(s_i, a_i))^2 (Algorithm 2), with Q `[B]` and the parameters."""
    q, critic = networks_lib.train_mode(networks.critic)(critic, batch.observation, batch.action)
    return jnp.mean(jnp.square(targets - q)), (q, critic)


def actor_loss(
    networks: ActorCritic, actor: Params, critic: Params, hparams: DDPGHParams, batch: Transition
) -> tuple[jax.Array, Params]:
    """-1/B sum_i Q(s_i, mu(s_i)), whose gradient is Eq. 3's, plus the pre-activation penalty."""
    pre_activation, actor = networks_lib.train_mode(networks.actor)(actor, batch.observation)
    q = networks.critic.apply(critic, batch.observation, networks.squash(pre_activation))
    penalty = jnp.mean(jnp.square(pre_activation))
    return -jnp.mean(q) + hparams.pre_activation_penalty * penalty, actor


def behaviour_cloning_loss(
    networks: ActorCritic,
    actor: Params,
    critic: Params,
    hparams: DDPGHParams,
    demonstrations: Transition,
) -> jax.Array:
    """w 1/D sum_i |mu(s_i) - a_i|^2 on demonstrations `[D, ...]`, added to the actor's loss.

    With `hparams.q_filter`, each term times 1{Q(s_i, a_i) > Q(s_i, mu(s_i))} (Nair et al. 2018).
    """
    observation, action = demonstrations.observation, demonstrations.action
    counts = None
    if hparams.q_filter:
        # A comparison: no gradient passes.
        counts = networks.critic.apply(critic, observation, action) > networks.critic.apply(
            critic, observation, networks_lib.policy(networks, actor, observation)
        )
    # The running statistics are the replay batch's alone to move.
    error, _ = networks_lib.imitation_error(networks, actor, observation, action, counts)
    return hparams.behaviour_cloning * error


def _when(predicate: Numeric, true_fn: Callable, false_fn: Callable, operand: Any) -> Any:
    """`lax.cond` that a Python bool resolves while tracing."""
    if isinstance(predicate, bool):
        return true_fn(operand) if predicate else false_fn(operand)
    return jax.lax.cond(predicate, true_fn, false_fn, operand)
