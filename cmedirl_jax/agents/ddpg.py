"""Deep deterministic policy gradient (Lillicrap et al. 2015), as the paper's Algorithm 2 uses it.

agent = ddpg.make(env.spec)
state = agent.init(jax.random.key(0))
state, info = jax.jit(agent.update)(state, batch)
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import checks, modes, observation_statistics, optimizers, ranges
from cmedirl_jax import networks as networks_lib
from cmedirl_jax.hyperparameters import traced
from cmedirl_jax.networks import ActorCritic
from cmedirl_jax.ranges import NotNegative, Positive, PositiveShare, Share
from cmedirl_jax.types import EnvSpec, Numeric, Params, Transition


class DDPGHParams(flax.struct.PyTreeNode):
    """Hyperparameters. The numbers are traced leaves of the state, to vmap over or to change.

    Attributes:
        discount: Discount gamma of the return, per environment step.
        tau: Share of the online parameters in each update of the targets; 1 copies them.
        actor_learning_rate: Adam's rate for the actor, per update.
        critic_learning_rate: Adam's rate for the critic, per update.
        reward_scale: Factor on every reward that the critic learns from.
        pre_activation_penalty: Weight of the mean squared pre-activation in the actor's loss; keeps
            the tanh from saturating.
        behaviour_cloning: Weight of the actor's mean squared error on demonstrated actions (in
            units of the action); the `tuned` preset sets 1.
        q_filter: Clone only the actions that the critic values above the actor's own (Nair et al.
            2018).
        bootstrap_at_termination: Leave (1 - terminated) out of the critic's target, as Algorithm 2
            is printed.
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
    """Everything that `update` changes, and the hyperparameters that it reads.

    Attributes:
        actor: parameters of the actor.
        critic: parameters of the critic.
        target_actor: parameters of the target actor.
        target_critic: parameters of the target critic.
        actor_optimizer: state of the actor's optimiser.
        critic_optimizer: state of the critic's optimiser.
        hparams: the hyperparameters, numbers as `[]` float32.
    """

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
        """Update on a batch.

        The three switches are bools, or scalar predicates that must not be batched under vmap.

        Args:
            state: the state before.
            batch: transitions, leaves `[B, ...]`; their rewards are those to learn from.
            demonstrations: leaves `[D, ...]`, for the behaviour-cloning term; None: no such term.
            update_actor: whether the actor learns.
            update_targets: whether the targets move; "every 300 steps" is a predicate and tau = 1.
            clone: whether the behaviour-cloning term is added, if there are demonstrations.

        Raises:
            ValueError: if the shapes of a batch are not `[B, O]`, `[B, A]` and `[B]`, or those of
                demonstrations not `[D, O]`, `[D, A]` and `[D]`.
            TypeError: if a leaf is not of floats, or `terminated` is not bool.
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

    `act`, `value` and `update` raise ValueError for wrong shapes and TypeError for wrong dtypes,
    while tracing.
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
            transformation has a rate of its own, or reads the extra argument `learning_rate=`.
        critic_optimizer: the same for the critic.

    Raises:
        ValueError: if the specification contradicts itself, or a hyperparameter is out of range.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    checks.env_spec(spec)
    hparams = hparams or DDPGHParams()
    ranges.check(hparams)
    parts = _Parts(
        spec=spec,
        networks=networks or networks_lib.make(spec),
        actor_optimizer=optax.with_extra_args_support(actor_optimizer or optimizers.adam()),
        critic_optimizer=optax.with_extra_args_support(critic_optimizer or optimizers.adam()),
    )
    return DDPG(
        networks=parts.networks,
        init=functools.partial(_init, parts, hparams),
        act=functools.partial(_act, parts),
        value=functools.partial(_value, parts),
        update=functools.partial(_update, parts),
    )


class _Parts(NamedTuple):
    """What the functions of one `DDPG` share. All static."""

    spec: EnvSpec
    networks: ActorCritic
    actor_optimizer: optax.GradientTransformationExtraArgs
    critic_optimizer: optax.GradientTransformationExtraArgs


def _init(
    parts: _Parts,
    hparams: DDPGHParams,
    key: jax.Array,
    params: tuple[Params, Params] | None = None,
) -> DDPGState:
    if params is None:
        actor_key, critic_key = jax.random.split(key)
        params = parts.networks.actor.init(actor_key), parts.networks.critic.init(critic_key)
    actor, critic = params
    return DDPGState(
        actor=actor,
        critic=critic,
        # Copies: a donated state must not hold the same buffer twice.
        target_actor=jax.tree.map(jnp.copy, actor),
        target_critic=jax.tree.map(jnp.copy, critic),
        actor_optimizer=parts.actor_optimizer.init(actor),
        critic_optimizer=parts.critic_optimizer.init(critic),
        hparams=traced(hparams),
    )


def _act(parts: _Parts, state: DDPGState, observation: jax.Array) -> jax.Array:
    checks.pairs(parts.spec, observation)
    return networks_lib.policy(parts.networks, state.actor, observation)


def _value(parts: _Parts, state: DDPGState, observation: jax.Array, action: jax.Array) -> jax.Array:
    checks.pairs(parts.spec, observation, action)
    return parts.networks.critic.apply(state.critic, observation, action)


def _update(
    parts: _Parts,
    state: DDPGState,
    batch: Transition,
    demonstrations: Transition | None = None,
    *,
    update_actor: Numeric = True,
    update_targets: Numeric = True,
    clone: Numeric = True,
) -> tuple[DDPGState, DDPGInfo]:
    for name, transitions in (("batch", batch), ("demonstrations", demonstrations)):
        if transitions is not None:
            leading = jnp.shape(transitions.observation)[:1]
            checks.transition_shapes(parts.spec, transitions, leading, name)

    # The critic first: the actor's gradient is taken through the new one.
    state, td_loss, q_mean = _update_critic(parts, state, batch)
    state, policy_loss = _when(
        update_actor,
        lambda state: _update_actor(parts, state, batch, demonstrations, clone),
        lambda state: (state, modes.vary(jnp.zeros((), jnp.float32), state, batch, demonstrations)),
        state,
    )
    state = _when(update_targets, _move_targets, lambda state: state, state)
    return state, DDPGInfo(td_loss, q_mean, policy_loss)


def _update_critic(
    parts: _Parts, state: DDPGState, batch: Transition
) -> tuple[DDPGState, jax.Array, jax.Array]:
    """Take a gradient step of the critic; also its loss and the mean of Q(s, a), before it."""
    targets = td_targets(parts.networks, state, batch)
    (loss, (q, critic)), grads = jax.value_and_grad(critic_loss, argnums=1, has_aux=True)(
        parts.networks, state.critic, batch, targets
    )
    updates, optimizer = parts.critic_optimizer.update(
        grads, state.critic_optimizer, critic, learning_rate=state.hparams.critic_learning_rate
    )
    critic = optax.apply_updates(critic, observation_statistics.fixed(updates))
    return state.replace(critic=critic, critic_optimizer=optimizer), loss, jnp.mean(q)


def _update_actor(
    parts: _Parts,
    state: DDPGState,
    batch: Transition,
    demonstrations: Transition | None,
    clone: Numeric,
) -> tuple[DDPGState, jax.Array]:
    """Take a gradient step of the actor; also its loss, before it."""
    gradient = functools.partial(_actor_gradient, parts.networks, state, batch)
    # A branch of its own, so that the cloning term costs nothing once it has faded out.
    (loss, actor), grads = _when(
        demonstrations is not None and clone,
        lambda actor: gradient(actor, demonstrations),
        lambda actor: gradient(actor, None),
        state.actor,
    )
    updates, optimizer = parts.actor_optimizer.update(
        grads, state.actor_optimizer, actor, learning_rate=state.hparams.actor_learning_rate
    )
    actor = optax.apply_updates(actor, observation_statistics.fixed(updates))
    # 32 bits under x64 too, as in the branch that leaves the actor alone.
    return state.replace(actor=actor, actor_optimizer=optimizer), loss.astype(jnp.float32)


def _actor_gradient(
    networks: ActorCritic,
    state: DDPGState,
    batch: Transition,
    actor: Params,
    demonstrations: Transition | None,
) -> tuple[tuple[jax.Array, Params], Params]:
    """The actor's loss, its parameters with running statistics moved, and the loss's gradient."""
    return jax.value_and_grad(actor_loss, argnums=1, has_aux=True)(
        networks, actor, state.critic, state.hparams, batch, demonstrations
    )


def _move_targets(state: DDPGState) -> DDPGState:
    """theta' <- tau theta + (1 - tau) theta' (Algorithm 2)."""

    def move(params: Params, target: Params) -> Params:
        return optax.incremental_update(params, target, state.hparams.tau)

    return state.replace(
        target_actor=move(state.actor, state.target_actor),
        target_critic=move(state.critic, state.target_critic),
    )


def td_targets(networks: ActorCritic, state: DDPGState, batch: Transition) -> jax.Array:
    """y = reward_scale r + gamma (1 - terminated) Q'(s', mu'(s')), `[B]`.

    Algorithm 2 prints it without (1 - terminated), as with `hparams.bootstrap_at_termination`.
    """
    next_action = networks_lib.policy(networks, state.target_actor, batch.next_observation)
    next_value = networks.critic.apply(state.target_critic, batch.next_observation, next_action)
    if not state.hparams.bootstrap_at_termination:
        next_value = jnp.where(batch.terminated, 0.0, next_value)
    return state.hparams.reward_scale * batch.reward + state.hparams.discount * next_value


def critic_loss(
    networks: ActorCritic, critic: Params, batch: Transition, targets: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, Params]]:
    """L = 1/B sum_i (y_i - Q(s_i, a_i))^2 `[]` (Algorithm 2); also Q `[B]` and the parameters.

    The parameters returned are those given, with running statistics moved where there are any.
    """
    q, critic = networks_lib.train_mode(networks.critic)(critic, batch.observation, batch.action)
    return jnp.mean(jnp.square(targets - q)), (q, critic)


def actor_loss(
    networks: ActorCritic,
    actor: Params,
    critic: Params,
    hparams: DDPGHParams,
    batch: Transition,
    demonstrations: Transition | None = None,
) -> tuple[jax.Array, Params]:
    """-1/B sum_i Q(s_i, mu(s_i)), whose gradient is Eq. 3's, plus the pre-activation penalty.

    With `demonstrations` `[D, ...]` also plus `behaviour_cloning_loss`. Also gives the parameters,
    with running statistics moved where there are any.
    """
    pre_activation, moved = networks_lib.train_mode(networks.actor)(actor, batch.observation)
    q = networks.critic.apply(critic, batch.observation, networks.squash(pre_activation))
    penalty = jnp.mean(jnp.square(pre_activation))
    loss = -jnp.mean(q) + hparams.pre_activation_penalty * penalty
    if demonstrations is not None:
        loss += behaviour_cloning_loss(networks, actor, critic, hparams, demonstrations)
    return loss, moved


def behaviour_cloning_loss(
    networks: ActorCritic,
    actor: Params,
    critic: Params,
    hparams: DDPGHParams,
    demonstrations: Transition,
) -> jax.Array:
    """w / (D A) sum_i |mu(s_i) - a_i|^2 on demonstrations `[D, ...]`, added to the actor's loss.

    `w` is `hparams.behaviour_cloning`. With `hparams.q_filter` each term is multiplied by
    1{Q(s_i, a_i) > Q(s_i, mu(s_i))} (Nair et al. 2018).
    """
    observation, action = demonstrations.observation, demonstrations.action
    counts = None
    if hparams.q_filter:
        # No gradient passes through a comparison.
        counts = networks.critic.apply(critic, observation, action) > networks.critic.apply(
            critic, observation, networks_lib.policy(networks, actor, observation)
        )
    # Only the replay batch moves the running statistics.
    error, _ = networks_lib.imitation_error(networks, actor, observation, action, counts)
    return hparams.behaviour_cloning * error


def _when(predicate: Numeric, true_fn: Callable, false_fn: Callable, operand: Any) -> Any:
    """`lax.cond`, decided while tracing if the predicate is a Python bool."""
    if isinstance(predicate, bool):
        return true_fn(operand) if predicate else false_fn(operand)
    return jax.lax.cond(predicate, true_fn, false_fn, operand)
