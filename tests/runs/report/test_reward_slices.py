import numpy as np
import pytest

from cmedirl_jax import envs
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.runs.report import reward_slices
from cmedirl_jax.runs.report.reward_samples import Learners
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.types import Transition
from tests.support import trainers

SEEDS, STEPS = 2, 50


@pytest.fixture(scope="module")
def learners():
    """Rewards w0 s0 + w1 s1^2 + w2 a of two seeds, on random steps."""
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(SEEDS, STEPS, 2)).astype(np.float32)
    action = rng.uniform(-1.0, 1.0, (SEEDS, STEPS, 1)).astype(np.float32)
    steps = Transition(observation, action, None, observation, None)
    weights = np.float32([[1.0, -2.0, 0.5], [0.0, 3.0, -1.0]])

    def reward(weight, observation, action):
        squared = weight[1] * observation[..., 1] ** 2
        return weight[0] * observation[..., 0] + squared + weight[2] * action[..., 0]

    return Learners(
        *(METHODS["me-ddpg"], 1, trainers.SMALL, np.arange(SEEDS), Rewards(reward, weights)),
        demonstrated=steps,
        played=steps,
        held_out=None,
    )


def test_inputs_are_named_in_the_order_in_which_a_reward_reads_them():
    names = ["observation[0]", "observation[1]", "action[0]"]
    assert reward_slices.inputs(envs.make("MountainCarContinuous-v0")) == names


@pytest.mark.parametrize("column", [0, 1, 2])
def test_a_slice_moves_one_input_and_averages_over_the_others(learners, column):
    found = reward_slices.of_learners(learners, column)
    steps = np.concatenate(learners.demonstrated[:2], axis=-1).astype(float)
    ends = np.quantile(steps[..., column], [0.01, 0.99])
    np.testing.assert_allclose(found.at, np.linspace(*ends, reward_slices.POINTS), rtol=1e-5)
    # By the mean of each term over the steps that are sliced through.
    sliced = steps[:, : reward_slices.STEPS] ** [1, 2, 1]
    means = np.repeat(sliced.mean(axis=1)[:, None], reward_slices.POINTS, axis=1)
    means[..., column] = found.at.astype(float) ** (2 if column == 1 else 1)
    expected = np.einsum("spc,sc->sp", means, learners.rewards.params)
    np.testing.assert_allclose(found.reward, expected, rtol=1e-4, atol=1e-5)
