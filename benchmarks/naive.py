"""The same algorithms written plainly: the reference that seeds per second are compared with.

What a competent first version looks like: flax modules and optax, one function that takes a step,
`lax.scan` over it, `vmap` over all seeds at once, a key split at every step, one array per field of
the replay and a write position for every seed. It shares no code with the library but the physics.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from benchmarks.workload import CAPACITY, Workload
from cmedirl_jax import envs
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.training.methods import METHODS

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
    """DDPG."""

    actor: Any
    critic: Any
    target_actor: Any
    target_critic: Any
    actor_optimizer: Any
    critic_optimizer: Any


class State(NamedTuple):
    """One seed."""

    key: jax.Array
    agent: Agent
    reward: Any
    reward_optimizer: Any
    replay: dict[str, jax.Array]
    taken: jax.Array
    env: Any
    observation: jax.Array
    noise: jax.Array


def start(workload: Workload, pool: Demonstrations) -> Callable[[int], None]:
    """A function that takes so many steps with every seed, compiled by its first call."""
    method = METHODS[workload.method]
    env = envs.make("MountainCarContinuous-v0")
    params = env.default_params
    # Any: by its type, Linen's `apply` might also return variables.
    actor: Any = Network(workload.hidden)
    critic: Any = Network(workload.hidden, workload.layer_norm)
    reward: Any = Network(workload.hidden)
    actor_tx, critic_tx, reward_tx = optax.adam(1e-4), optax.adam(1e-3), optax.adam(1e-3)
    demonstrated = jax.tree.map(jnp.asarray, (pool.transition.observation, pool.transition.action))

    def init(key):
        keys = jax.random.split(key, 5)
        observation, action = jnp.zeros(2), jnp.zeros(1)
        actor_params = actor.init(keys[0], observation)
        critic_params = critic.init(keys[1], observation, action)
        reward_params = reward.init(keys[2], observation, action)
        env_state, first = env.reset(keys[3], params)
        return State(
            key=keys[4],
            agent=Agent(
                actor=actor_params,
                critic=critic_params,
                target_actor=actor_params,
                target_critic=critic_params,
                actor_optimizer=actor_tx.init(actor_params),
                critic_optimizer=critic_tx.init(critic_params),
            ),
            reward=reward_params,
            reward_optimizer=reward_tx.init(reward_params),
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

    def policy(actor_params, observation):
        return jnp.tanh(actor.apply(actor_params, observation))[..., None]

    def learned_reward(reward_params, observation, action):
        return BOUND * jnp.tanh(reward.apply(reward_params, observation, action))

    def update_reward(state: State, key) -> State:
        demonstration_key, background_key = jax.random.split(key)
        rows = jax.random.randint(demonstration_key, (workload.batch,), 0, len(demonstrated[0]))
        expert = jax.tree.map(lambda leaf: leaf[rows], demonstrated)
        index = jax.random.randint(background_key, (workload.batch,), 0, state.taken)
        background = state.replay["observation"][index], state.replay["action"][index]

        def loss(reward_params):
            everything = jax.tree.map(lambda *x: jnp.concatenate(x), expert, background)
            output = reward.apply(reward_params, *everything)
            gap = jnp.mean(BOUND * jnp.tanh(output)) - jnp.mean(
                learned_reward(reward_params, *expert)
            )
            return gap + OUTPUT_PENALTY * jnp.mean(output**2)

        grads = jax.grad(loss)(state.reward)
        updates, optimizer = reward_tx.update(grads, state.reward_optimizer)
        return state._replace(
            reward=optax.apply_updates(state.reward, updates), reward_optimizer=optimizer
        )

    def update_agent(state: State, key) -> Agent:
        agent = state.agent
        index = jax.random.randint(key, (workload.batch,), 0, state.taken)
        batch = {name: field[index] for name, field in state.replay.items()}
        rewards = batch["reward"]
        if method.learns_reward:
            rewards += learned_reward(state.reward, batch["observation"], batch["action"])
        next_value = critic.apply(
            agent.target_critic,
            batch["next_observation"],
            policy(agent.target_actor, batch["next_observation"]),
        )
        targets = rewards + DISCOUNT * (1.0 - batch["terminated"]) * next_value

        def critic_loss(critic_params):
            q = critic.apply(critic_params, batch["observation"], batch["action"])
            return jnp.mean((q - targets) ** 2)

        grads = jax.grad(critic_loss)(agent.critic)
        updates, critic_optimizer = critic_tx.update(grads, agent.critic_optimizer)
        critic_params = optax.apply_updates(agent.critic, updates)

        def actor_loss(actor_params):
            output = actor.apply(actor_params, batch["observation"])
            q = critic.apply(critic_params, batch["observation"], jnp.tanh(output)[..., None])
            loss = -jnp.mean(q) + PENALTY * jnp.mean(output**2)
            if method.hot_start:
                rows = jax.random.randint(key, (workload.batch,), 0, len(demonstrated[0]))
                observation, action = jax.tree.map(lambda leaf: leaf[rows], demonstrated)
                loss += jnp.mean((policy(actor_params, observation) - action) ** 2)
            return loss

        grads = jax.grad(actor_loss)(agent.actor)
        updates, actor_optimizer = actor_tx.update(grads, agent.actor_optimizer)
        actor_params = optax.apply_updates(agent.actor, updates)
        return Agent(
            actor=actor_params,
            critic=critic_params,
            target_actor=optax.incremental_update(actor_params, agent.target_actor, TAU),
            target_critic=optax.incremental_update(critic_params, agent.target_critic, TAU),
            actor_optimizer=actor_optimizer,
            critic_optimizer=critic_optimizer,
        )

    def step(state: State, number) -> tuple[State, jax.Array]:
        keys = jax.random.split(state.key, 6)
        noise = (1.0 - THETA) * state.noise + SIGMA * jax.random.normal(keys[1], (1,))
        action = jnp.clip(policy(state.agent.actor, state.observation) + noise, -1.0, 1.0)
        env_state, result = env.step(keys[2], state.env, action, params)
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
        fresh_env, fresh_observation = env.reset(keys[3], params)
        env_state, observation, noise = jax.tree.map(
            lambda new, old: jnp.where(done, new, old),
            (fresh_env, fresh_observation, jnp.zeros(1)),
            (env_state, result.observation, noise),
        )
        state = state._replace(
            key=keys[0],
            replay=replay,
            taken=state.taken + 1,
            env=env_state,
            observation=observation,
            noise=noise,
        )
        if method.learns_reward:
            state = jax.lax.cond(
                number % REWARD_PERIOD == 0,
                lambda state: update_reward(state, keys[4]),
                lambda state: state,
                state,
            )
        agent = jax.lax.cond(
            state.taken >= LEARNING_STARTS,
            lambda state: update_agent(state, keys[5]),
            lambda state: state.agent,
            state,
        )
        return state._replace(agent=agent), result.reward

    @jax.jit
    def run(states, numbers):
        return jax.vmap(lambda state: jax.lax.scan(step, state, numbers))(states)

    states = jax.jit(jax.vmap(init))(jax.random.split(jax.random.key(0), workload.seeds))
    taken = 0

    def advance(steps: int) -> None:
        nonlocal states, taken
        states, _ = jax.block_until_ready(run(states, jnp.arange(taken, taken + steps)))
        taken += steps

    return advance
