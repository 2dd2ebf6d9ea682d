"""The IRL update inside another agent's loop: evolution strategies, which know no gradient."""

import jax
import jax.numpy as jnp

import cmedirl_jax as cm

STEPS, POPULATION, ITERATIONS, BATCH = 60, 32, 10, 64
SKILLED = jnp.array([[-2, 0], [0, -2], [-1.5, 0], [0, -1.5], [1.4, 1.4]])  # flies to the goal


def play(env, weights, key):
    """Steps of a linear policy: `Transition` with leaves `[STEPS, ...]`."""

    def one(carry, key):
        state, seen = carry
        action = jnp.clip(jnp.append(seen, 1.0) @ weights, -1.0, 1.0)
        state, step = env.step(key, state, action, env.default_params)
        pair = cm.Transition(seen, action, step.reward, step.observation, step.terminated)
        return (state, step.observation), pair

    return jax.lax.scan(one, env.reset(key, env.default_params), jax.random.split(key, STEPS))[1]


def train(key, env, shown, generations):
    """r_e `[generations]`, mean of a step; only r_D, learned from `shown`, is paid."""
    irl = cm.irl.make(env.spec)

    def generation(carry, key):
        reward, mean = carry
        keys = jax.random.split(key, POPULATION + 2)
        noise = 0.2 * jax.random.normal(keys[0], (POPULATION, *SKILLED.shape))
        played = jax.vmap(lambda one, key: play(env, mean + one, key))(noise, keys[2:])

        def learn(reward, key):  # ours: Algorithm 1, demonstrations against the population
            some = jnp.divmod(jax.random.randint(key, (BATCH,), 0, played.reward.size), STEPS)
            batches = [jax.tree.map(lambda leaf: leaf[some], pool) for pool in (shown, played)]
            return irl.update(reward, *batches)[0], None

        reward, _ = jax.lax.scan(learn, reward, jax.random.split(keys[1], ITERATIONS))

        # Theirs: a step towards those who were paid more.
        paid = irl.reward(reward, played.observation, played.action).mean(axis=1)
        rank = jnp.argsort(jnp.argsort(paid)) / (POPULATION - 1) - 0.5
        return (reward, mean + 0.5 * jnp.tensordot(rank, noise, axes=1)), played.reward.mean()

    start = (irl.init(key), jnp.zeros_like(SKILLED))
    return jax.lax.scan(generation, start, jax.random.split(key, generations))[1]


def main(generations=200):
    """Mean r_e of a step: of the demonstrator, of the first and of the last generations."""
    env, keys = cm.envs.make("PointMass-v0"), jax.random.split(jax.random.key(1), POPULATION)
    shown = jax.vmap(lambda key: play(env, SKILLED, key))(keys)  # as many as are played
    earned = jax.jit(lambda key: train(key, env, shown, generations))(jax.random.key(0))
    return shown.reward.mean(), earned[:5].mean(), earned[-5:].mean()


if __name__ == "__main__":
    print("r_e of a step: shown {:.2f}, population {:.2f} before, {:.2f} after".format(*main()))
