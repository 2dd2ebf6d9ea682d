"""States and batches keep their 32-bit types under `jax_enable_x64`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import irl
from cmedirl_jax.agents import ddpg, exploration, hot_start
from cmedirl_jax.agents.exploration import EpsilonGreedyHParams
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.data import demonstrations, episodes, replay
from cmedirl_jax.irl import IRLHParams, rewards
from cmedirl_jax.types import DemonstrationSubset, RewardBatch
from tests.support import pools
from tests.support.agents import random_batch

SPEC, PARAMS = pools.ENV.spec, pools.ENV.default_params
KEY = jax.random.key(0)
BATCH = jax.tree.map(np.asarray, random_batch(KEY, 6))
STEP = np.int32(3)


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


def assert_32_bits(function, *arguments):
    """Trace a function, and return the shapes and dtypes of its result."""
    result = jax.eval_shape(function, *arguments)
    wide = [leaf for leaf in jax.tree.leaves(result) if leaf.dtype in (jnp.float64, jnp.int64)]
    assert not wide
    return result


def test_the_environment():
    state, _ = assert_32_bits(pools.ENV.reset, KEY, PARAMS)
    assert_32_bits(pools.ENV.step, KEY, state, np.zeros(1, np.float32), PARAMS)
    assert_32_bits(lambda: pools.ENV.starts(3, PARAMS))


@pytest.mark.parametrize("cloned", [None, BATCH])
def test_the_agent(cloned):
    agent = ddpg.make(SPEC)
    state = assert_32_bits(agent.init, KEY)
    assert_32_bits(agent.update, state, BATCH, cloned)
    for switch in ("update_actor", "update_targets", "clone"):
        assert_32_bits(
            lambda state, due, switch=switch: agent.update(state, BATCH, cloned, **{switch: due}),
            state,
            np.array(True),
        )


@pytest.mark.parametrize("critic", ["softmax", "one-hot", "quadratic", "monte-carlo"])
def test_the_hot_start(critic):
    agent, data = ddpg.make(SPEC), hot_start.data(pools.scripted(2))
    state = jax.eval_shape(agent.init, KEY)
    hparams = HotStartHParams(critic=critic, steps=2)
    assert_32_bits(
        lambda actor, critic: hot_start.fit(KEY, agent.networks, (actor, critic), data, hparams),
        state.actor,
        state.critic,
    )


@pytest.mark.parametrize(
    "behaviour",
    [
        exploration.gaussian(SPEC),
        exploration.ornstein_uhlenbeck(SPEC),
        exploration.epsilon_greedy(SPEC),
        exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(noise=0.1)),
    ],
    ids=["gaussian", "ornstein-uhlenbeck", "epsilon-greedy", "noisy epsilon-greedy"],
)
def test_explorations(behaviour):
    state, action = assert_32_bits(behaviour.init, KEY), BATCH.action[0]
    assert_32_bits(behaviour.sample, KEY, state, action, STEP)
    assert_32_bits(behaviour.log_density, state, action, action, STEP)


@pytest.mark.parametrize(
    "learner",
    [
        irl.make(SPEC),
        irl.make(SPEC, IRLHParams(absorbing=True, gauge="zero-mean", gradient_penalty=0.1)),
        irl.make(
            SPEC,
            IRLHParams(objective="transition", weight_limit=1.0),
            network=rewards.linear(SPEC, rewards.fourier(SPEC, 2)),
        ),
        irl.make(SPEC, network=rewards.linear(SPEC, rewards.radial_basis(SPEC, 3))),
        irl.gail.make(SPEC),
        irl.controls.random(SPEC),
        irl.controls.constant(0.1),
    ],
    ids=["visitation", "absorbing", "fourier", "radial basis", "gail", "random", "constant"],
)
def test_reward_learners(learner):
    state = assert_32_bits(learner.init, KEY)
    assert_32_bits(learner.reward, state, BATCH.observation, BATCH.action)
    assert_32_bits(lambda state: learner.update(state, BATCH, BATCH, key=KEY), state)


def test_trajectories():
    whole = jax.tree.map(lambda leaf: leaf[None], BATCH)
    batch = RewardBatch(whole, np.zeros(1, np.float32), np.ones((1, 6), bool))
    learner = irl.make(SPEC, IRLHParams(objective="trajectory", discount=0.9, absorbing=True))
    state = assert_32_bits(learner.init, KEY)
    assert_32_bits(lambda state: learner.update(state, batch, batch), state)


def test_data():
    buffer, ring = replay.make(SPEC, 10), episodes.make(3, 10, 5)
    state, one = assert_32_bits(buffer.init), jax.tree.map(lambda leaf: leaf[0], BATCH)
    assert_32_bits(buffer.add, state, one)
    assert_32_bits(lambda state: buffer.sample(KEY, state, 4), state)
    assert_32_bits(ring.step, assert_32_bits(ring.init), STEP, np.array(True))
    subset = DemonstrationSubset(np.int32([0, 3]), np.int32([3, 3]))
    assert_32_bits(lambda subset: demonstrations.sample_index(KEY, subset, 4), subset)
    assert_32_bits(lambda subset: demonstrations.subset(KEY, subset, 1), subset)
    assert_32_bits(lambda subset: demonstrations.sample_episodes(KEY, subset, 4), subset)
