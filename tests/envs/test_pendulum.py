"""Parity with Gymnasium's Pendulum-v1."""

import chex
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import envs
from cmedirl_jax.envs.pendulum import PendulumState
from tests.support.compiling import jit_as_users

ENV = envs.make("Pendulum-v1")
PARAMS = ENV.default_params
KEY = jax.random.key(0)

step = jit_as_users(ENV.step)
step_many = jit_as_users(jax.vmap(ENV.step, in_axes=(None, 0, 0, None)))


@pytest.fixture(scope="module")
def pendulum():
    return gymnasium.make("Pendulum-v1").unwrapped


def gymnasium_step(pendulum, angle, speed, action):
    pendulum.state = np.array([angle, speed])
    pendulum.last_u = None
    observation, reward, terminated, _, _ = pendulum.step(np.array([action], np.float32))
    return *observation, reward, terminated


@pytest.mark.optimised
def test_step_matches_gymnasium_on_a_grid(pendulum):
    angles = np.r_[np.linspace(-7.0, 7.0, 41), -np.pi, np.pi, 0.0]
    speeds = np.linspace(-8.0, 8.0, 17)
    actions = [-5.0, -2.001, -2.0, -0.4, 0.0, 1.3, 2.0, 2.001, 5.0]
    grid = np.stack(np.meshgrid(angles, speeds, actions, indexing="ij"), axis=-1)
    grid = grid.reshape(-1, 3).astype(np.float32)
    states = PendulumState(grid[:, 0], grid[:, 1], np.zeros(len(grid), np.int32))
    result = jax.device_get(step_many(KEY, states, grid[:, 2:], PARAMS)[1])
    expected = np.array([gymnasium_step(pendulum, *row) for row in grid.astype(np.float64)])

    np.testing.assert_allclose(result.observation, expected[:, :3], rtol=0, atol=5e-6)
    # Next to pi rounding decides the side, and so a cost of pi^2 either way: they are equal.
    np.testing.assert_allclose(result.reward, expected[:, 3], rtol=2e-6, atol=2e-5)
    assert not result.terminated.any()
    assert not expected[:, 4].any()
    # The grid reaches the speed limits.
    assert (np.abs(expected[:, 2]) == 8.0).sum() > 50


@pytest.mark.optimised
@pytest.mark.parametrize("seed", range(3))
def test_whole_episodes_match_gymnasium(seed):
    env = gymnasium.make("Pendulum-v1")
    observation, _ = env.reset(seed=seed)
    angle, speed = env.unwrapped.state
    state = PendulumState(jnp.float32(angle), jnp.float32(speed), jnp.int32(0))
    rng = np.random.default_rng(seed)
    for time in range(200):
        # It swings against the motion, so that rounding is not amplified.
        action = np.clip(-observation[2:] + 0.3 * rng.normal(size=1), -2.0, 2.0)
        observation, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
        state, answer = step(KEY, state, action.astype(np.float32), PARAMS)
        np.testing.assert_allclose(answer.observation, observation, atol=2e-3)
        np.testing.assert_allclose(answer.reward, reward, atol=5e-3)
        assert bool(answer.truncated) == truncated == (time == 199)
        assert not terminated


def test_the_specification_is_gymnasiums():
    env, spec = gymnasium.make("Pendulum-v1"), ENV.spec
    np.testing.assert_array_equal(spec.observation_low, env.observation_space.low)
    np.testing.assert_array_equal(spec.observation_high, env.observation_space.high)
    np.testing.assert_array_equal(spec.action_low, env.action_space.low)
    np.testing.assert_array_equal(spec.action_high, env.action_space.high)
    assert spec.max_episode_steps == env.spec.max_episode_steps
    assert spec.reward_threshold is env.spec.reward_threshold is None


def test_it_keeps_to_its_specification():
    envs.check(ENV)


def test_starts_are_drawn_as_gymnasium_draws_them():
    reset = jax.jit(jax.vmap(ENV.reset, in_axes=(0, None)))
    states, _ = jax.device_get(reset(jax.random.split(KEY, 4_000), PARAMS))
    assert np.abs(states.angle).max() == pytest.approx(np.pi, abs=0.01)
    assert np.abs(states.speed).max() == pytest.approx(1.0, abs=0.01)
    assert np.abs(np.mean(states.angle)) < 0.1


def test_fixed_starts_are_the_same_at_every_call():
    chex.assert_trees_all_equal(ENV.starts(5, PARAMS), ENV.starts(5, PARAMS))
    _, observations = ENV.starts(5, PARAMS)
    assert len(np.unique(np.asarray(observations), axis=0)) == 5


@given(st.floats(-3.1, 3.1), st.floats(-8.0, 8.0))
def test_an_observation_determines_the_state(angle, speed):
    state = PendulumState(jnp.float32(angle), jnp.float32(speed), jnp.int32(0))
    observation = jnp.stack([jnp.cos(state.angle), jnp.sin(state.angle), state.speed])
    chex.assert_trees_all_close(ENV.state_at(observation, PARAMS), state, atol=1e-5)
    np.testing.assert_array_equal(ENV.gymnasium_state(state), np.float32([angle, speed]))


def test_physics_are_traced_parameters():
    def speed_after(gravity):
        state = PendulumState(jnp.float32(1.0), jnp.float32(0.0), jnp.int32(0))
        return ENV.step(KEY, state, jnp.zeros(1), PARAMS.replace(gravity=gravity))[1].observation[2]

    found = jax.jit(jax.vmap(speed_after))(np.float32([0.0, 10.0, 20.0]))
    np.testing.assert_allclose(found, 1.5 * np.sin(1.0) * 0.05 * np.array([0, 10, 20]), rtol=1e-5)
    assert jax.jit(jax.grad(speed_after))(10.0) == pytest.approx(1.5 * np.sin(1.0) * 0.05, rel=1e-5)
