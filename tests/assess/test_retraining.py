"""Fresh agents on frozen rewards, judged by the environment's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs, training
from cmedirl_jax.assess import retraining
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.networks import Architecture
from cmedirl_jax.training import seeds
from cmedirl_jax.training.schedules import Schedule
from cmedirl_jax.training.settings import Settings

ENV = envs.make("PointMass-v0")
SETTINGS = Settings(
    architecture=Architecture(hidden=(16,)), schedule=Schedule(learning_starts=20, batch_size=16)
)
SIZES = {"steps": 80, "evaluate_every": 40, "evaluation_starts": 2, "settings": SETTINGS}
KEYS = seeds.keys(jax.random.key(4), 3)


def constant(params, observation, action):
    return jnp.broadcast_to(params, observation.shape[:-1])


def test_on_the_tasks_own_reward_it_is_ddpg():
    own = jax.jit(lambda: retraining.retrain(KEYS, ENV, None, **SIZES))()
    whole = jax.jit(
        lambda: training.fit(jax.random.key(4), ENV, "ddpg", seeds=3, **SIZES).evaluations
    )()
    assert own.return_mean.shape == (3, 1, 3)
    np.testing.assert_allclose(np.asarray(own.return_mean)[:, 0], whole.return_mean, rtol=1e-4)


def test_each_agent_has_its_reward_and_each_world_its_physics():
    values = np.array([0.0, 0.3, -0.3], np.float32)
    physics = jax.tree.map(lambda leaf: np.stack([np.asarray(leaf)] * 2), ENV.default_params)
    physics = physics.replace(push=physics.push * np.array([1.0, 3.0], np.float32))
    train = jax.jit(
        lambda keys, values, physics: retraining.retrain(
            keys, ENV, Rewards(constant, values), physics, **SIZES
        )
    )
    found = jax.device_get(train(KEYS, values, physics))
    assert found.return_mean.shape == (3, 2, 3)
    # Before any step agents differ by their networks alone.
    again = jax.device_get(train(KEYS, values[::-1], physics))
    np.testing.assert_array_equal(found.return_mean[:, :, 0], again.return_mean[:, :, 0])
    assert not np.allclose(found.return_mean[:, 0], found.return_mean[:, 1])
    np.testing.assert_allclose(found.return_mean[1], again.return_mean[1], rtol=1e-4)
    assert not np.allclose(found.return_mean[0, :, 1:], again.return_mean[0, :, 1:])


def test_steps_are_whole_evaluations():
    with pytest.raises(ValueError, match="must be a multiple of evaluate_every"):
        retraining.retrain(KEYS, ENV, None, steps=100, evaluate_every=60)
