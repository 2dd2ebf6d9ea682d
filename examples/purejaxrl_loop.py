"""A learned reward in a loop of one's own, as PureJaxRL writes them: one jitted function trains.

    cmedirl reward results/PointMass-v0 --export r_d
    python examples/purejaxrl_loop.py r_d

The agent is not this library's: an actor-critic that learns from batches of parallel episodes.
"""

import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

import cmedirl_jax as cm


class Step(NamedTuple):
    """What one step of `N` parallel environments gives, each `[N, ...]`."""

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    done: jax.Array
    environment_reward: jax.Array


def make_train(env, reward, *, envs=32, steps=25, updates=150, discount=0.97, rate=1e-2):
    """Return `key -> [updates]`: mean r_e of a step, of an agent that learns from r_D alone."""
    networks = cm.networks.make(env.spec)
    optimizer = optax.adam(rate)
    params = env.default_params

    def train(key):
        key, actor_key, critic_key, reset_key = jax.random.split(key, 4)
        weights = (networks.actor.init(actor_key), networks.critic.init(critic_key))
        start = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(reset_key, envs), params)

        def env_step(carry, key):
            weights, state, observation = carry
            noise_key, step_key, reset_key = jax.random.split(key, 3)
            mean = networks.squash(networks.actor.apply(weights[0], observation))
            action = mean + 0.3 * jax.random.normal(noise_key, mean.shape)
            action = jnp.clip(action, env.spec.action_low, env.spec.action_high)
            keys = jax.random.split(step_key, envs)
            after, answer = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, state, action, params)
            # The learned reward in place of the environment's: the only line that is ours.
            paid = reward(observation, action)
            done = answer.terminated | answer.truncated
            fresh = jax.vmap(env.reset, in_axes=(0, None))(
                jax.random.split(reset_key, envs), params
            )
            state, observed = jax.tree.map(
                lambda new, old: jnp.where(done.reshape(-1, *[1] * (new.ndim - 1)), new, old),
                fresh,
                (after, answer.observation),
            )
            step = Step(observation, action, paid, done, answer.reward)
            return (weights, state, observed), step

        def loss(weights, batch, last):
            def value(observation):
                size = (*observation.shape[:-1], env.spec.action_dim)
                return networks.critic.apply(weights[1], observation, jnp.zeros(size))

            def back(after, step):
                now = step.reward + discount * jnp.where(step.done, 0.0, after)
                return now, now

            targets = jax.lax.scan(back, value(last), batch, reverse=True)[1]
            mean = networks.squash(networks.actor.apply(weights[0], batch.observation))
            advantage = jax.lax.stop_gradient(targets - value(batch.observation))
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
            log_density = -jnp.sum(jnp.square(batch.action - mean), axis=-1) / (2 * 0.3**2)
            error = jax.lax.stop_gradient(targets) - value(batch.observation)
            return -jnp.mean(advantage * log_density) + jnp.mean(jnp.square(error))

        def update(carry, key):
            weights, optimizer_state, state, observation = carry
            (_, state, observation), batch = jax.lax.scan(
                env_step, (weights, state, observation), jax.random.split(key, steps)
            )
            gradient = jax.grad(loss)(weights, batch, observation)
            changes, optimizer_state = optimizer.update(gradient, optimizer_state)
            weights = optax.apply_updates(weights, changes)
            carry = (weights, optimizer_state, state, observation)
            return carry, jnp.mean(batch.environment_reward)

        carry = (weights, optimizer.init(weights), *start)
        return jax.lax.scan(update, carry, jax.random.split(key, updates))[1]

    return train


if __name__ == "__main__":
    exported = cm.export.load(sys.argv[1])
    env = cm.envs.make(exported.card["task"])
    paid = jax.jit(make_train(env, exported.functions["reward"]))(jax.random.key(0))
    print(f"mean r_e of a step: {paid[:10].mean():.3f} at first, {paid[-10:].mean():.3f} at last")
