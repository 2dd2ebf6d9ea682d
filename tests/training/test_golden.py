"""A short run of each method gives the values it always gave.

`python -m tests.test_golden` writes them anew: only after a change that is meant to change them.
"""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import training
from cmedirl_jax.agents import hot_start
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.training import seeds
from cmedirl_jax.training.methods import METHODS, PAPER_METHODS
from cmedirl_jax.training.schedules import Schedule
from cmedirl_jax.training.settings import Settings
from tests.support import pools

GOLDEN = Path(__file__).with_name("golden.json")
SEEDS, STEPS, LEARNING_STARTS = 2, 120, 40
SETTINGS = dataclasses.replace(
    Settings(),
    schedule=Schedule(learning_starts=LEARNING_STARTS),
    hot_start=HotStartHParams(steps=30),
)


@functools.cache
def prepared():
    return jax.tree.map(jnp.asarray, hot_start.data(pools.scripted()))


@functools.cache
def beginning(hot):
    """Compiled once for all methods: `key -> networks`, hot-started or as they are drawn."""
    trainer = training.make(pools.ENV, METHODS["bc" if hot else "ddpg"], SETTINGS, capacity=STEPS)
    if not hot:
        return jax.jit(trainer.draw_networks)
    return jax.jit(lambda key, drawn: trainer.hot_start(key, prepared(), 3, drawn))


def short_run(name):
    """Norms of what was learned, where the car is, and the last update's diagnostics."""
    method = METHODS[name]
    data = prepared() if method.uses_demonstrations else None
    trainer = training.make(pools.ENV, method, SETTINGS, capacity=STEPS)

    # One seed's program compiles faster than that of several.
    @jax.jit
    def train(key, networks):
        return trainer.run(trainer.init(key, data, 3, networks), data, jnp.arange(STEPS))

    def run(key):
        networks = beginning(hot=False)(key)
        if method.hot_start:
            networks = beginning(hot=True)(key, networks)
        return train(key, networks)

    def norms(tree):
        return [np.linalg.norm(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves(tree)]

    def values(state, log):
        return {
            "actor": norms(state.agent.actor),
            "critic": norms(state.agent.critic),
            "target_critic": norms(state.agent.target_critic),
            "reward": [] if state.reward is None else norms(state.reward.params.network),
            "observation": np.asarray(state.observation),
            "episode_return": np.asarray(state.episode_return),
            "replay": norms(state.storage),
            "q_mean": np.asarray(log.q_mean)[-1],
            "critic_loss": np.asarray(log.critic_loss)[-1],
        }

    keys = seeds.keys(jax.random.key(8), SEEDS)
    if name == "hs-me-ddpg":
        # As users do: seeds side by side that draw and fit networks of their own.
        both = jax.jit(jax.vmap(lambda key: train(key, None)))(keys)
        of_seeds = [values(*jax.tree.map(lambda leaf, i=i: leaf[i], both)) for i in range(SEEDS)]
    else:
        of_seeds = [values(*run(key)) for key in keys]
    return jax.tree.map(lambda *leaves: np.stack(leaves).astype(float).tolist(), *of_seeds)


@pytest.mark.parametrize("name", ["ddpg", "hs-ddpg", "me-ddpg", "hs-me-ddpg"])
def test_a_short_run_gives_the_values_it_always_gave(name):
    golden = json.loads(GOLDEN.read_text())[name]
    found = short_run(name)
    assert found.keys() == golden.keys()
    for key, values in golden.items():
        # Eighty updates let other roundings (another processor, another compiler) grow a little.
        np.testing.assert_allclose(found[key], values, rtol=2e-3, atol=2e-4, err_msg=key)


if __name__ == "__main__":
    GOLDEN.write_text(
        json.dumps({name: short_run(name) for name in PAPER_METHODS}, indent=1) + "\n"
    )
