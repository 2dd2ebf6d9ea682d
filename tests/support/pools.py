"""Small pools of demonstrations: by a scripted controller of known quality, and random ones."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st

from cmedirl_jax import envs
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.runs.cells.pools import of_learners
from cmedirl_jax.types import Transition

ENV = envs.make("MountainCarContinuous-v0")


def controller(observation, push=0.3):
    """Push in the direction of motion: a mean return of about 97.7, or with 0.8 of 92.9."""
    return push * jnp.where(observation[..., 1:] >= 0, 1.0, -1.0)


@functools.cache
def scripted(episodes=12, push=0.3):
    """`episodes` episodes of `controller`, at rest from -0.6 to -0.4."""
    params = ENV.default_params

    def advance(carry, _):
        state, observation = carry
        action = controller(observation, push)
        state, step = ENV.step(jax.random.key(0), state, action, params)
        row = Transition(observation, action, step.reward, step.observation, step.terminated)
        return (state, step.observation), (row, step.truncated & ~step.terminated)

    def play(position):
        observation = jnp.stack([position, 0.0])
        start = ENV.state_at(observation, params), observation
        return jax.lax.scan(advance, start, length=ENV.spec.max_episode_steps)[1]

    positions = np.linspace(-0.6, -0.4, episodes, dtype=np.float32)
    transition, truncated = jax.device_get(jax.jit(jax.vmap(play))(positions))
    ended = transition.terminated | truncated
    played = np.cumsum(ended, axis=1) - ended == 0
    transition = jax.tree.map(lambda leaf: leaf[played], transition)
    episode = np.nonzero(played)[0].astype(np.int32)
    return Demonstrations(transition, truncated[played], episode, {"env": ENV.spec.id})


def for_learners(pool, learners=8):
    """A pool as cells take it: each learner may draw from all of it."""
    return of_learners(pool, learners).data


episode_lengths = st.lists(st.integers(1, 6), min_size=1, max_size=8)


def random_pool(lengths, seed=0, last_unfinished=False):
    """Episodes of the given lengths, every other one truncated, of random numbers in bounds."""
    rng = np.random.default_rng(seed)
    steps = sum(lengths)
    episode = np.repeat(np.arange(len(lengths), dtype=np.int32), lengths)
    last = np.r_[episode[1:] != episode[:-1], not last_unfinished]

    def uniform(*shape):
        return rng.uniform(-1, 1, (steps, *shape)).astype(np.float32)

    observation = uniform(2) * ENV.spec.observation_high
    following = np.where(last[:, None], 0.5 * observation, np.roll(observation, -1, axis=0))
    return Demonstrations(
        Transition(observation, uniform(1), uniform(), following, last & (episode % 2 == 0)),
        truncated=last & (episode % 2 == 1),
        episode=episode,
        metadata={"env": ENV.spec.id, "expert": "scripted", "seeds": [1, 2]},
    )
