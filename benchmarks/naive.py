"""The same algorithms written plainly: the reference that seeds per second are compared with.

A competent first version looks like this: flax modules and optax, one function that takes a
step, `lax.scan` over it, `vmap` over all seeds at once, a key split at every step, one array per
field of the replay and a write position for every seed. It shares only its physics with ours.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from benchmarks.workload import CAPACITY, Workload
from cmedirl_jax import envs
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env
from cmedirl_jax.training.methods import METHODS, Method

DISCOUNT, TAU, PENALTY, THETA, SIGMA = 0.99, 0.01, 1e-3, 0.15, 0.5
BOUND, OUTPUT_PENALTY, REWARD_PERIOD = 0.1, 0.05, 4
LEARNING_STARTS = 200


class Network(nn.Module):
    """An MLP over the scaled observation and, for values, the action."""

    hidden: tuple[int, ...]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, observation, action=None):
        """`[..., 2]` and `[..., 1]` to `[...]`."""
        x = (observation - jnp.array([-0.3, 0.0])) / jnp.array([0.9, 0.07])
        if action is not None:
            x = jnp.concatenate([x, action], axis=-1)
        for units in self.hidden:
            x = nn.Dense(units)(x)
            if self.layer_norm:
                x = nn.LayerNorm(use_bias=False, use_scale=False)(x)
            x = nn.relu(x)
        return nn.Dense(1)(x)[..., 0]


class Agent(NamedTuple):
    """Parameters, targets and optimisers of DDPG."""

    actor: Any
    critic: Any
    target_actor: Any
    target_critic: Any
    actor_optimizer: Any
    critic_optimizer: Any


class State(NamedTuple):
    """Everything that changes while one seed trains."""

    key: jax.Array
    agent: Agent
    reward: Any
    reward_optimizer: Any
    replay: dict[str, jax.Array]
    taken: jax.Array
    env: Any
    observation: jax.Array
    noise: jax.Array


class Parts(NamedTuple):
    """What stays the same while the seeds train.

    Attributes:
        demonstrated: observations `[N, 2]` and actions `[N, 1]`.
    """

    workload: Workload
    method: Method
    env: Env
    actor: Network
    critic: Network
    reward: Network
    actor_optimizer: optax.GradientTransformation
    critic_optimizer: optax.GradientTransformation
    reward_optimizer: optax.GradientTransformation
    demonstrated: tuple[jax.Array, jax.Array]


def start(workload: Workload, pool: Demonstrations) -> Callable[[int], None]:
    """A function that takes so many steps with every seed, compiled by its first call."""
    parts = Parts(
        workload=workload,
        method=METHODS[workload.method],
        env=envs.make("MountainCarContinuous-v0"),
        actor=Network(workload.hidden),
        critic=Network(workload.hidden, workload.layer_norm),
        reward=Network(workload.hidden),
        actor_optimizer=optax.adam(1e-4),
        critic_optimizer=optax.adam(1e-3),
        reward_optimizer=optax.adam(1e-3),
        demonstrated=jax.tree.map(
            jnp.asarray, (pool.transition.observation, pool.transition.action)
        ),
    )

    @jax.jit
    def run(states, numbers):
        one_step = functools.partial(step, parts)
        return jax.vmap(lambda state: jax.lax.scan(one_step, state, numbers))(states)

    init_all = jax.jit(jax.vmap(functools.partial(init, parts)))
    states = init_all(jax.random.split(jax.random.key(0), workload.seeds))
    taken = 0

    def advance(steps: int) -> None:
        nonlocal states, taken
        states, _ = jax.block_until_ready(run(states, jnp.arange(taken, taken + steps)))
        taken += steps

    return advance


def init(parts: Parts, key: jax.Array) -> State:
    """A seed before its first step."""
    keys = jax.random.split(key, 5)
    observation, action = jnp.zeros(2), jnp.zeros(1)
    actor = parts.actor.init(keys[0], observation)
    critic = parts.critic.init(keys[1], observation, action)
    reward = parts.reward.init(keys[2], observation, action)
    env_state, first = parts.env.reset(keys[3], parts.env.default_params)
    return State(
        key=keys[4],
        agent=Agent(
            actor=actor,
            critic=critic,
            target_actor=actor,
            target_critic=critic,
            actor_optimizer=parts.actor_optimizer.init(actor),
            critic_optimizer=parts.critic_optimizer.init(critic),
        ),
        reward=reward,
        reward_optimizer=parts.reward_optimizer.init(reward),
        replay={
            "observation": jnp.zeros((CAPACITY, 2)),
            "action": jnp.zeros((CAPACITY, 1)),
            "reward": jnp.zeros(CAPACITY),
            "next_observation": jnp.zeros((CAPACITY, 2)),
            "terminated": jnp.zeros(CAPACITY, bool),
        },
        taken=jnp.zeros((), jnp.int32),
        env=env_state,
        observation=first,
        noise=jnp.zeros(1),
    )


def step(parts: Parts, state: State, number: jax.Array) -> tuple[State, jax.Array]:
    """Act, then learn the reward and the agent; returns the environment's reward too."""
    keys = jax.random.split(state.key, 6)
    state, reward = act(parts, state._replace(key=keys[0]), keys[1:4])
    if parts.method.learns_reward:
        state = jax.lax.cond(
            number % REWARD_PERIOD == 0,
            lambda state: update_reward(parts, state, keys[4]),
            lambda state: state,
            state,
        )
    agent = jax.lax.cond(
        state.taken >= LEARNING_STARTS,
        lambda state: update_agent(parts, state, keys[5]),
        lambda state: state.agent,
        state,
    )
    return state._replace(agent=agent), reward


def act(parts: Parts, state: State, keys: jax.Array) -> tuple[State, jax.Array]:
    """Take a noisy action, store the transition, and begin a new episode where one ended."""
    params = parts.env.default_params
    noise = (1.0 - THETA) * state.noise + SIGMA * jax.random.normal(keys[0], (1,))
    action = jnp.clip(policy(parts, state.agent.actor, state.observation) + noise, -1.0, 1.0)
    env_state, result = parts.env.step(keys[1], state.env, action, params)
    row = {
        "observation": state.observation,
        "action": action,
        "reward": result.reward,
        "next_observation": result.observation,
        "terminated": result.terminated,
    }
    position = state.taken % CAPACITY
    replay = {name: field.at[position].set(row[name]) for name, field in state.replay.items()}
    done = result.terminated | result.truncated
    fresh_env, fresh_observation = parts.env.reset(keys[2], params)
    env_state, observation, noise = jax.tree.map(
        lambda new, old: jnp.where(done, new, old),
        (fresh_env, fresh_observation, jnp.zeros(1)),
        (env_state, result.observation, noise),
    )
    state = state._replace(
        replay=replay,
        taken=state.taken + 1,
        env=env_state,
        observation=observation,
        noise=noise,
    )
    return state, result.reward


def output(network: Network, params: Any, *inputs: jax.Array) -> jax.Array:
    """The network's output, `[...]`."""
    return cast(jax.Array, network.apply(params, *inputs))


def policy(parts: Parts, actor: Any, observation: jax.Array) -> jax.Array:
    """mu(s), `[..., 1]`."""
    return jnp.tanh(output(parts.actor, actor, observation))[..., None]


def learned_reward(parts: Parts, reward: Any, observation: jax.Array, action: jax.Array):
    """r_D(s, a), `[...]`."""
    return BOUND * jnp.tanh(output(parts.reward, reward, observation, action))


def update_reward(parts: Parts, state: State, key: jax.Array) -> State:
    """A step along mu_D - E[mu], from demonstrated pairs and pairs of the replay."""
    batch = parts.workload.batch
    demonstration_key, background_key = jax.random.split(key)
    rows = jax.random.randint(demonstration_key, (batch,), 0, len(parts.demonstrated[0]))
    expert = jax.tree.map(lambda leaf: leaf[rows], parts.demonstrated)
    index = jax.random.randint(background_key, (batch,), 0, state.taken)
    background = state.replay["observation"][index], state.replay["action"][index]

    def loss(reward):
        everything = jax.tree.map(lambda *x: jnp.concatenate(x), expert, background)
        f = output(parts.reward, reward, *everything)
        gap = jnp.mean(BOUND * jnp.tanh(f)) - jnp.mean(learned_reward(parts, reward, *expert))
        return gap + OUTPUT_PENALTY * jnp.mean(f**2)

    gradient = jax.grad(loss)(state.reward)
    updates, optimizer = parts.reward_optimizer.update(gradient, state.reward_optimizer)
    return state._replace(
        reward=optax.apply_updates(state.reward, updates), reward_optimizer=optimizer
    )


def update_agent(parts: Parts, state: State, key: jax.Array) -> Agent:
    """A step of the critic, one of the actor, then both targets."""
    index = jax.random.randint(key, (parts.workload.batch,), 0, state.taken)
    batch = {name: field[index] for name, field in state.replay.items()}
    agent = update_critic(parts, state.agent, state.reward, batch)
    agent = update_actor(parts, agent, batch["observation"], key)
    return agent._replace(
        target_actor=optax.incremental_update(agent.actor, agent.target_actor, TAU),
        target_critic=optax.incremental_update(agent.critic, agent.target_critic, TAU),
    )


def update_critic(parts: Parts, agent: Agent, reward: Any, batch: dict[str, jax.Array]) -> Agent:
    """A step on the squared temporal-difference error."""
    rewards = batch["reward"]
    if parts.method.learns_reward:
        rewards += learned_reward(parts, reward, batch["observation"], batch["action"])
    next_action = policy(parts, agent.target_actor, batch["next_observation"])
    next_value = output(parts.critic, agent.target_critic, batch["next_observation"], next_action)
    targets = rewards + DISCOUNT * (1.0 - batch["terminated"]) * next_value

    def loss(critic):
        q = output(parts.critic, critic, batch["observation"], batch["action"])
        return jnp.mean((q - targets) ** 2)

    gradient = jax.grad(loss)(agent.critic)
    updates, optimizer = parts.critic_optimizer.update(gradient, agent.critic_optimizer)
    critic = optax.apply_updates(agent.critic, updates)
    return agent._replace(critic=critic, critic_optimizer=optimizer)


def update_actor(parts: Parts, agent: Agent, observation: jax.Array, key: jax.Array) -> Agent:
    """A step along the critic's gradient, and towards the demonstrations after a hot start."""

    def loss(actor):
        pre_activation = output(parts.actor, actor, observation)
        action = jnp.tanh(pre_activation)[..., None]
        q = output(parts.critic, agent.critic, observation, action)
        loss = -jnp.mean(q) + PENALTY * jnp.mean(pre_activation**2)
        if parts.method.hot_start:
            seen, shown = parts.demonstrated
            rows = jax.random.randint(key, (parts.workload.batch,), 0, len(seen))
            loss += jnp.mean((policy(parts, actor, seen[rows]) - shown[rows]) ** 2)
        return loss

    gradient = jax.grad(loss)(agent.actor)
    updates, optimizer = parts.actor_optimizer.update(gradient, agent.actor_optimizer)
    actor = optax.apply_updates(agent.actor, updates)
    return agent._replace(actor=actor, actor_optimizer=optimizer)
