"""A short run of each method gives the values it always gave.

`python -m tests.test_golden` writes them anew: only after a change that is meant to change them.
"""

import dataclasses
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


def short_run(name):
    """Norms of what was learned, where the car is, and the last update's diagnostics."""
    settings = dataclasses.replace(
        Settings(),
        schedule=Schedule(learning_starts=LEARNING_STARTS),
        hot_start=HotStartHParams(steps=30),
    )
    method = METHODS[name]
    data = hot_start.data(pools.scripted()) if method.uses_demonstrations else None
    trainer = training.make(pools.ENV, method, settings, capacity=STEPS)

    @jax.jit
    @jax.vmap
    def run(key):
        return trainer.run(trainer.init(key, data, 3), data, jnp.arange(STEPS))

    state, log = run(seeds.keys(jax.random.key(8), SEEDS))

    def norms(tree):
        return [
            np.sqrt(np.square(np.asarray(leaf, np.float64)).sum(axis=tuple(range(1, leaf.ndim))))
            for leaf in jax.tree.leaves(tree)
        ]

    values = {
        "actor": norms(state.agent.actor),
        "critic": norms(state.agent.critic),
        "target_critic": norms(state.agent.target_critic),
        "reward": [] if state.reward is None else norms(state.reward.params.network),
        "observation": state.observation,
        "episode_return": state.episode_return,
        "replay": norms(state.storage),
        "q_mean": log.q_mean[:, -1],
        "critic_loss": log.critic_loss[:, -1],
    }
    return {key: np.asarray(value, np.float64).tolist() for key, value in values.items()}


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
