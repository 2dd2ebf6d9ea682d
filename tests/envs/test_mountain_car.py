"""Parity with Gymnasium's MountainCarContinuous-v0, and what the port adds to it."""

import chex
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import envs
from cmedirl_jax.envs.mountain_car import MountainCarState
from tests.support.compiling import jit_as_users

ENV = envs.make("MountainCarContinuous-v0")
PARAMS = ENV.default_params
KEY = jax.random.key(0)

step = jit_as_users(ENV.step)
step_many = jit_as_users(jax.vmap(ENV.step, in_axes=(None, 0, 0, None)))


@pytest.fixture(scope="module")
def car():
    return gymnasium.make("MountainCarContinuous-v0").unwrapped


def state(position, velocity, time=0):
    return MountainCarState(jnp.float32(position), jnp.float32(velocity), jnp.int32(time))


def gymnasium_step(car, position, velocity, action):
    car.state = np.array([position, velocity], np.float32)
    observation, reward, terminated, _, _ = car.step(np.array([action], np.float32))
    return *observation, reward, terminated


def state_action_grid():
    just = 1e-5
    walls_and_goal = [-1.2 + just, -1.19, 0.42, 0.45 - just, 0.45, 0.45 + just, 0.6 - just]
    positions = np.r_[np.linspace(-1.2, 0.6, 46), walls_and_goal]
    velocities = np.r_[np.linspace(-0.07, 0.07, 31), -just, just, -0.07 + just, 0.07 - just]
    actions = [-3.0, -1.001, -1.0, -0.4, 0.0, 0.2, 1.0, 1.001, 3.0]
    grid = np.meshgrid(positions, velocities, actions, indexing="ij")
    return np.stack(grid, axis=-1).reshape(-1, 3).astype(np.float32)


@pytest.mark.optimised
def test_step_matches_gymnasium_on_a_grid(car):
    grid = state_action_grid()
    states = MountainCarState(grid[:, 0], grid[:, 1], np.zeros(len(grid), np.int32))
    result = jax.device_get(step_many(KEY, states, grid[:, 2:], PARAMS)[1])
    expected = np.array([gymnasium_step(car, *row) for row in grid])

    np.testing.assert_allclose(result.observation, expected[:, :2], rtol=0, atol=1e-6)
    # Rounding decides on which side of the goal's edge some states lie: leave them out.
    tie = (np.abs(expected[:, 0] - car.goal_position) < 1e-6) | (np.abs(expected[:, 1]) < 1e-7)
    tie &= expected[:, 0] > car.goal_position - 1e-6
    assert tie.mean() < 0.01
    np.testing.assert_array_equal(result.terminated[~tie], expected[~tie, 3])
    np.testing.assert_allclose(result.reward[~tie], expected[~tie, 2], rtol=1e-6, atol=1e-6)


def test_the_grid_reaches_both_walls_the_speed_limits_and_the_goal(car):
    position, velocity, _, terminated = np.array(
        [gymnasium_step(car, *row) for row in state_action_grid()]
    ).T
    assert ((position == np.float32(-1.2)) & (velocity == 0)).sum() > 100
    assert (position == np.float32(0.6)).sum() > 100
    assert (np.abs(velocity) == np.float32(0.07)).sum() > 100
    assert (terminated == 1).sum() > 100


@pytest.mark.optimised
def test_the_cost_is_of_the_action_given_and_the_force_of_the_clipped_one():
    _, beyond = step(KEY, state(-0.5, 0.0), jnp.array([3.0]), PARAMS)
    _, at_bound = step(KEY, state(-0.5, 0.0), jnp.array([1.0]), PARAMS)
    np.testing.assert_array_equal(beyond.observation, at_bound.observation)
    np.testing.assert_allclose(beyond.reward, -0.9, rtol=1e-6)


@pytest.mark.optimised
@pytest.mark.parametrize(
    ("position", "velocity", "terminated"),
    [
        (0.45, 0.0, True),
        (np.nextafter(np.float32(0.45), np.float32(0)), 0.0, False),
        (0.5, 1e-6, True),
        (0.5, -1e-6, False),
        (0.44, 0.02, True),
        (0.47, -0.02, False),
    ],
)
def test_the_goal_is_a_position_reached_without_moving_back(position, velocity, terminated):
    coasting = PARAMS.replace(power=0.0, gravity=0.0)
    _, result = step(KEY, state(position, velocity), jnp.zeros(1), coasting)
    assert result.terminated == terminated
    assert result.reward == (100.0 if terminated else 0.0)


def ornstein_uhlenbeck_noise(rng, rollouts, steps):
    noise = np.zeros((rollouts, steps), np.float32)
    for t in range(1, steps):
        noise[:, t] = 0.85 * noise[:, t - 1] + 0.5 * rng.standard_normal(rollouts)
    return noise


def gymnasium_episode(car, start, actions):
    """Length, termination, return and whether the left wall was hit."""
    car.state = np.array([start, 0.0], np.float32)
    rewards, hit = [], False
    for action in actions:
        observation, reward, terminated, _, _ = car.step(action[None])
        rewards.append(reward)
        hit |= observation[0] == np.float32(-1.2)
        if terminated:
            break
    return len(rewards), terminated, sum(rewards), hit


@jit_as_users
@jax.vmap
def episode(start, actions):
    def advance(car_state, action):
        return ENV.step(KEY, car_state, action[None], PARAMS)

    return jax.lax.scan(advance, state(start, 0.0), actions)[1]


@pytest.mark.optimised
def test_noisy_episodes_match_gymnasium(car):
    rng = np.random.default_rng(0)
    starts = rng.uniform(-0.6, -0.4, 200).astype(np.float32)
    actions = ornstein_uhlenbeck_noise(rng, 200, 999)
    expected = [gymnasium_episode(car, *pair) for pair in zip(starts, actions, strict=True)]
    expected_length, expected_terminated, expected_return, hit = map(
        np.array, zip(*expected, strict=True)
    )
    assert hit.sum() > 50
    assert 20 < expected_terminated.sum() < 180

    result = jax.device_get(episode(starts, actions))
    ended = result.terminated | result.truncated
    length = np.argmax(ended, axis=1) + 1
    lived = np.arange(999) < length[:, None]
    np.testing.assert_array_equal(length, expected_length)
    np.testing.assert_array_equal((result.terminated & lived).any(axis=1), expected_terminated)
    episode_return = np.sum(result.reward * lived, axis=1, dtype=np.float64)
    np.testing.assert_allclose(episode_return, expected_return, rtol=0, atol=1e-4)


@pytest.mark.optimised
@pytest.mark.parametrize(
    ("position", "time", "terminated", "truncated"),
    [(-0.5, 997, 0, 0), (-0.5, 998, 0, 1), (0.5, 997, 1, 0), (0.5, 998, 1, 1)],
)
def test_the_time_limit_truncates_and_the_goal_terminates(position, time, terminated, truncated):
    new_state, result = step(KEY, state(position, 0.03, time), jnp.zeros(1), PARAMS)
    assert (result.terminated, result.truncated) == (terminated, truncated)
    assert new_state.time == time + 1


def test_reset_rests_somewhere_in_the_start_interval():
    reset = jax.jit(jax.vmap(ENV.reset, in_axes=(0, None)))
    states, observations = jax.device_get(reset(jax.random.split(KEY, 1000), PARAMS))
    np.testing.assert_array_equal(
        observations, np.stack([states.position, states.velocity], axis=-1)
    )
    assert observations.dtype == jnp.float32
    position = np.asarray(states.position)
    assert np.float32(-0.6) <= position.min() < -0.599
    assert -0.401 < position.max() <= np.float32(-0.4)
    assert not states.velocity.any()
    assert not states.time.any()


def test_starts_are_the_midpoints_of_equal_parts_and_at_rest():
    states, observations = ENV.starts(5, PARAMS)
    np.testing.assert_allclose(states.position, [-0.58, -0.54, -0.5, -0.46, -0.42], rtol=1e-6)
    np.testing.assert_array_equal(observations, np.stack([states.position, np.zeros(5)], axis=-1))
    assert not states.time.any()


def test_physics_can_be_vmapped_over(car, monkeypatch):
    powers = np.array([0.0005, 0.0015, 0.003], np.float32)
    axes = jax.tree.map(lambda _: None, PARAMS).replace(power=0)
    _, result = jax.jit(jax.vmap(ENV.step, in_axes=(None, None, None, axes)))(
        KEY, state(-0.5, 0.01), jnp.array([0.7]), PARAMS.replace(power=powers)
    )
    result = jax.device_get(result)
    assert len(np.unique(result.observation[:, 1])) == len(powers)
    for power, observation in zip(powers, result.observation, strict=True):
        monkeypatch.setattr(car, "power", float(power))
        expected = gymnasium_step(car, -0.5, 0.01, 0.7)[:2]
        np.testing.assert_allclose(observation, expected, rtol=0, atol=1e-6)


def test_velocity_is_differentiable_in_the_power():
    def velocity(power):
        params = PARAMS.replace(power=power)
        return ENV.step(KEY, state(-0.5, 0.01), jnp.array([0.7]), params)[0].velocity

    np.testing.assert_allclose(jax.jit(jax.grad(velocity))(0.0015), 0.7, rtol=1e-6)


def in_bounds(index):
    low, high = ENV.spec.observation_low[index], ENV.spec.observation_high[index]
    return st.floats(float(low), float(high), width=32)


@pytest.mark.optimised
@given(
    position=in_bounds(0),
    velocity=in_bounds(1),
    action=st.floats(allow_nan=False, allow_infinity=False, width=32),
)
def test_observations_stay_in_the_spec_bounds(position, velocity, action):
    _, result = step(KEY, state(position, velocity), jnp.array([action], jnp.float32), PARAMS)
    assert (result.observation >= ENV.spec.observation_low).all()
    assert (result.observation <= ENV.spec.observation_high).all()


def test_other_values_do_not_recompile():
    # The wrapper is a new function: jitted copies of one function share compiled programs.
    jitted = jax.jit(chex.assert_max_traces(ENV.step, n=1))
    jitted(KEY, state(-0.5, 0.0), jnp.array([0.1]), PARAMS)
    jitted(jax.random.key(1), state(0.2, 0.05, 7), jnp.array([-0.4]), PARAMS.replace(power=0.002))


@pytest.mark.optimised
def test_a_batch_of_one_equals_no_batch():
    single = step(KEY, state(-0.7, 0.02, 3), jnp.array([0.3]), PARAMS)
    batch = jax.tree.map(lambda x: np.asarray(x)[None], state(-0.7, 0.02, 3))
    batched = step_many(KEY, batch, jnp.array([[0.3]]), PARAMS)
    chex.assert_trees_all_equal(single, jax.tree.map(lambda leaf: np.asarray(leaf)[0], batched))


@pytest.mark.optimised
def test_step_keeps_shapes_and_dtypes():
    before = state(-0.5, 0.0)
    after, result = step(KEY, before, jnp.zeros(1), PARAMS)
    assert jax.tree.map(jnp.result_type, after) == jax.tree.map(jnp.result_type, before)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), result) == envs.Step(
        ((2,), jnp.float32), ((), jnp.float32), ((), jnp.bool_), ((), jnp.bool_)
    )
