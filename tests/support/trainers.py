"""Small trainers on a car with short episodes, compiled once per method and settings."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import training
from cmedirl_jax.agents import hot_start
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.irl.reward_batches import RewardBatchSettings
from cmedirl_jax.irl.rewards import RewardNetworkSettings
from cmedirl_jax.networks import Architecture
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.schedules import RewardSchedule, Schedule
from cmedirl_jax.training.settings import Settings
from tests.support import pools

LIMIT = 40
ENV = pools.ENV._replace(
    spec=pools.ENV.spec._replace(max_episode_steps=LIMIT),
    default_params=pools.ENV.default_params.replace(max_episode_steps=LIMIT),
)
SMALL = Settings(
    architecture=Architecture(hidden=(8, 8)),
    schedule=Schedule(batch_size=8, learning_starts=10),
    reward_network=RewardNetworkSettings(hidden=(8,)),
    reward_batches=RewardBatchSettings(batch_size=8),
    reward_schedule=RewardSchedule(stop=None),
    hot_start=HotStartHParams(steps=20),
)


@functools.cache
def data():
    return jax.tree.map(jnp.asarray, hot_start.data(pools.scripted(), 0.99))


def with_(settings=SMALL, **changes):
    """`settings` with fields of its groups changed: with_(schedule={"batch_size": 4})."""
    groups = {}
    for name, fields in changes.items():
        group = getattr(settings, name)
        groups[name] = dataclasses.replace(group, **fields)
    return dataclasses.replace(settings, **groups)


@functools.cache
def compiled(method, settings=SMALL, capacity=400):
    trainer = training.make(ENV, METHODS[method], settings, capacity=capacity)
    # The fit of a table is hundreds of small programs where it is not one.
    init = trainer.init
    if METHODS[method].tabular:
        init = jax.jit(init, static_argnums=2)
    return trainer, init, jax.jit(trainer.run)


@functools.cache
def networks(method, architecture, hot_start, key):
    """What a method's `init` starts from, hot-started once for all its other settings."""
    settings = dataclasses.replace(SMALL, architecture=architecture, hot_start=hot_start)
    trainer, _, _ = compiled(method, settings)
    key = jax.random.key(key)
    return trainer.hot_start(key, data(), 3, trainer.draw_networks(key))


def start(method, settings=SMALL, key=0, **kwargs):
    trainer, init, run = compiled(method, settings, **kwargs)
    pool = data() if METHODS[method].uses_demonstrations else None
    hot = None
    if METHODS[method].hot_start:
        hot = networks(method, settings.architecture, settings.hot_start, key)
    state = init(jax.random.key(key), pool, 3, hot)

    def advance(state, begin, end, max_episodes=None):
        """Step by step: each number of steps at once would be a program to compile."""
        logs = []
        for step in range(begin, end):
            state, log = run(state, pool, np.arange(step, step + 1, dtype=np.int32), max_episodes)
            logs.append(log)
        return state, jax.tree.map(lambda *parts: np.concatenate(parts), *logs)

    return trainer, state, advance
