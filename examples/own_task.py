"""Learn a reward on a task of one's own, from a pilot who docks a boat: `python own_task.py`."""

import jax
import jax.numpy as jnp
import numpy as np

import cmedirl_jax as cm

LIMIT, LOW, HIGH = 60, np.float32([-6.0, -2.0]), np.float32([6.0, 2.0])  # place, speed
ONE = np.ones(1, np.float32)
SPEC = cm.EnvSpec("Dock-v0", 2, 1, LOW, HIGH, -ONE, ONE, LIMIT, reward_threshold=None)


def reset(key, params):
    state = jnp.append(jax.random.uniform(key, (1,), minval=-5.0, maxval=-3.0), 0.0)
    return (state, jnp.int32(0)), state


def step(key, state, action, params):
    (place, speed), time = state
    speed = 0.9 * speed + 0.2 * action[0]
    after = jnp.clip(jnp.stack([place + 0.2 * speed, speed]), LOW, HIGH)
    answer = cm.envs.Step(after, -jnp.abs(after[0]), jnp.zeros((), bool), time + 1 >= LIMIT)
    return (after, time + 1), answer


def starts(count, params):  # where policies are evaluated
    return jax.vmap(reset, in_axes=(0, None))(jax.random.split(jax.random.key(0), count), params)


def piloted(env, episodes=20):
    """A pool of episodes whose pilot slows down in time."""

    def pilot(carry, key):
        state, seen = carry
        action = jnp.clip(-seen[:1] - 2.0 * seen[1:], -1.0, 1.0)
        state, answer = env.step(key, state, action, ())
        pair = cm.Transition(seen, action, answer.reward, answer.observation, answer.terminated)
        return (state, answer.observation), (pair, answer.truncated)

    keys = jax.random.split(jax.random.key(1), LIMIT)
    drives = jax.vmap(lambda *start: jax.lax.scan(pilot, start, keys)[1])(*env.starts(episodes, ()))
    transition, truncated = jax.tree.map(lambda x: np.concatenate(np.asarray(x)), drives)
    episode = np.repeat(np.arange(episodes, dtype=np.int32), LIMIT)
    return cm.demonstrations.Demonstrations(transition, truncated, episode, {"env": SPEC.id})


def main(seeds=8, steps=3_000):
    """Mean r_e of an episode: of the pilot, and before and after learning from r_D alone."""
    env = cm.envs.Env(SPEC, (), reset, step, starts)
    cm.envs.check(env)
    pool, sizes = piloted(env), {"seeds": seeds, "steps": steps, "evaluate_every": steps // 2}
    fit = jax.jit(lambda key: cm.training.fit(key, env, "irl-only", pool, **sizes))
    returns = fit(jax.random.key(0)).evaluations.return_mean.mean(axis=0)
    return cm.demonstrations.returns(pool).mean(), returns[0], returns[-1]


if __name__ == "__main__":
    print("r_e of an episode: pilot {:.0f}, agent before {:.0f}, after {:.0f}".format(*main()))
