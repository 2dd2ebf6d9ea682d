"""DDPG as a single-file script: a Python loop over Gymnasium, one seed, jitted updates.

Written for this benchmark in the manner of CleanRL's JAX scripts: the replay is numpy, and critic
and actor are each a jitted function of a flax `TrainState`.
"""

from typing import Any

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.training.train_state import TrainState

from benchmarks.serving import serve_from_command_line

CAPACITY, BATCH, LEARNING_STARTS, DISCOUNT, TAU = 12_000, 32, 200, 0.99, 0.01


class Critic(nn.Module):
    """Q(s, a)."""

    @nn.compact
    def __call__(self, observation, action):
        """`[B, 2]`, `[B, 1]` to `[B]`."""
        x = jnp.concatenate([observation, action], -1)
        x = nn.relu(nn.Dense(64)(x))
        x = nn.relu(nn.Dense(64)(x))
        return nn.Dense(1)(x)[:, 0]


class Actor(nn.Module):
    """mu(s)."""

    @nn.compact
    def __call__(self, observation):
        """`[B, 2]` to `[B, 1]`."""
        x = nn.relu(nn.Dense(64)(observation))
        x = nn.relu(nn.Dense(64)(x))
        return jnp.tanh(nn.Dense(1)(x))


class Learner(TrainState):
    """Parameters, their targets and their optimiser."""

    target_params: Any


def learner(module: nn.Module, rate: float, *inputs: jax.Array) -> Learner:
    """A network's initial state."""
    params = module.init(jax.random.PRNGKey(0), *inputs)
    return Learner.create(
        apply_fn=module.apply, params=params, target_params=params, tx=optax.adam(rate)
    )


actor = learner(Actor(), 1e-4, jnp.zeros((1, 2)))
critic = learner(Critic(), 1e-3, jnp.zeros((1, 2)), jnp.zeros((1, 1)))


@jax.jit
def act(actor: Learner, observation):
    """The greedy action."""
    return actor.apply_fn(actor.params, observation)


@jax.jit
def update_critic(actor: Learner, critic: Learner, observation, action, reward, after, terminated):
    """One step on the temporal-difference error."""
    next_action = actor.apply_fn(actor.target_params, after)
    next_value = critic.apply_fn(critic.target_params, after, next_action)
    target = reward + DISCOUNT * (1.0 - terminated) * next_value

    def loss(params):
        return jnp.mean((critic.apply_fn(params, observation, action) - target) ** 2)

    return critic.apply_gradients(grads=jax.grad(loss)(critic.params))


@jax.jit
def update_actor(actor: Learner, critic: Learner, observation):
    """One step along the critic's gradient, then both targets."""

    def loss(params):
        return -critic.apply_fn(
            critic.params, observation, actor.apply_fn(params, observation)
        ).mean()

    actor = actor.apply_gradients(grads=jax.grad(loss)(actor.params))
    return tuple(
        state.replace(
            target_params=optax.incremental_update(state.params, state.target_params, TAU)
        )
        for state in (actor, critic)
    )


environment = gymnasium.make("MountainCarContinuous-v0")
generator = np.random.default_rng(0)
columns = {
    "observation": np.zeros((CAPACITY, 2), np.float32),
    "action": np.zeros((CAPACITY, 1), np.float32),
    "reward": np.zeros(CAPACITY, np.float32),
    "after": np.zeros((CAPACITY, 2), np.float32),
    "terminated": np.zeros(CAPACITY, np.float32),
}
observation, _ = environment.reset(seed=0)
taken = 0


def advance(steps: int) -> None:
    """Take so many steps."""
    global actor, critic, observation, taken
    for _ in range(steps):
        greedy = np.asarray(act(actor, observation[None]))[0]
        action = np.clip(greedy + 0.5 * generator.normal(size=1), -1, 1).astype(np.float32)
        after, reward, terminated, truncated, _ = environment.step(action)
        row = (observation, action, reward, after, terminated)
        for column, value in zip(columns.values(), row, strict=True):
            column[taken % CAPACITY] = value
        taken += 1
        observation = environment.reset()[0] if terminated or truncated else after
        if taken >= LEARNING_STARTS:
            index = generator.integers(0, min(taken, CAPACITY), BATCH)
            batch = {name: column[index] for name, column in columns.items()}
            critic = update_critic(actor, critic, **batch)
            actor, critic = update_actor(actor, critic, batch["observation"])
    jax.block_until_ready((actor, critic))


serve_from_command_line(advance)
