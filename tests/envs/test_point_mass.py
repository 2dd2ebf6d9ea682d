import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import envs
from cmedirl_jax.envs.point_mass import PointMassState
from tests.support.compiling import jit_as_users

ENV = envs.make("PointMass-v0")
PARAMS = ENV.default_params
KEY = jax.random.key(0)
step = jit_as_users(ENV.step)

unit = st.floats(-1.0, 1.0, width=32)
pair = st.tuples(unit, unit)


def state(position, velocity=(0.0, 0.0)):
    return PointMassState(jnp.float32(position), jnp.float32(velocity), jnp.int32(0))


def by_hand(position, velocity, action):
    """The definition, in float64."""
    position, velocity, action = (np.array(x, float) for x in (position, velocity, action))
    velocity = np.clip(0.9 * velocity + 0.2 * np.clip(action, -1, 1), -1, 1)
    free = position + 0.1 * velocity
    position = np.clip(free, -1, 1)
    velocity[free != position] = 0.0
    distance = np.hypot(*(position - 0.7))
    discs = [np.hypot(*(position - disc)) for disc in ([0.0, 0.0], [0.5, 0.1])]
    reward = -0.01 * (action**2).sum() - 0.1 * distance
    reward += 10.0 * (distance <= 0.15) - 0.5 * (min(discs) < 0.25)
    return np.r_[position, velocity], reward, distance, min(discs)


@given(pair, pair, st.tuples(st.floats(-2, 2, width=32), st.floats(-2, 2, width=32)))
def test_a_step_is_its_definition(position, velocity, action):
    observation, reward, distance, disc = by_hand(position, velocity, action)
    _, found = jax.device_get(step(KEY, state(position, velocity), np.float32(action), PARAMS))
    at_wall = np.abs(np.abs(observation[:2]) - 1.0) < 1e-6
    np.testing.assert_allclose(found.observation[:2], observation[:2], atol=1e-6)
    np.testing.assert_allclose(
        found.observation[2:][~at_wall], observation[2:][~at_wall], atol=1e-6
    )
    # Rounding decides on the edges of the goal and of the discs.
    if abs(distance - 0.15) > 1e-5 and abs(disc - 0.25) > 1e-5:
        np.testing.assert_allclose(found.reward, reward, atol=1e-5)
        assert bool(found.terminated) == (distance <= 0.15)


def test_a_wall_stops_the_velocity_towards_it_alone():
    _, found = step(KEY, state((0.99, 0.0), (1.0, 0.5)), jnp.zeros(2), PARAMS)
    np.testing.assert_allclose(found.observation, [1.0, 0.045, 0.0, 0.45], atol=1e-6)


def test_it_keeps_to_its_specification():
    envs.check(ENV)


def play(policy):
    current, observation = ENV.reset(KEY, PARAMS)
    total = 0.0
    for time in range(100):
        current, answer = step(KEY, current, policy(np.asarray(observation)), PARAMS)
        observation, total = answer.observation, total + float(answer.reward)
        if answer.terminated or answer.truncated:
            return total, time + 1, bool(answer.terminated)
    raise AssertionError("the episode did not end")


def test_around_the_discs_is_better_than_through_them_and_both_than_nothing():
    def towards(way):
        def act(observation):
            left = way(observation) - observation[:2]
            return np.clip(4.0 * left - 2.0 * observation[2:], -1.0, 1.0)

        return act

    goal = np.float32([0.7, 0.7])
    straight = play(towards(lambda observation: goal))
    # First up along the left wall, then right.
    around = play(towards(lambda seen: np.where(seen[1] < 0.5, np.float32([-0.6, 0.9]), goal)))
    nothing = play(lambda observation: np.zeros(2, np.float32))
    assert straight[2]
    assert around[2]
    assert nothing[1:] == (100, False)
    assert around[0] > straight[0] > nothing[0]


def test_starts_are_fixed_and_within_the_square():
    chex.assert_trees_all_equal(ENV.starts(5, PARAMS), ENV.starts(5, PARAMS))
    _, observations = jax.device_get(ENV.starts(500, PARAMS))
    assert (np.abs(observations[:, :2] + 0.7) <= 0.2 + 1e-6).all()
    assert np.ptp(observations[:, 0]) > 0.35
    assert not np.any(observations[:, 2:])


@given(pair, pair)
def test_an_observation_determines_the_state(position, velocity):
    expected = state(position, velocity)
    observation = np.concatenate([expected.position, expected.velocity])
    chex.assert_trees_all_equal(ENV.state_at(observation, PARAMS), expected)


def test_where_the_goal_lies_is_a_traced_parameter():
    def distance_cost(x):
        params = PARAMS.replace(goal=jnp.stack([x, 0.7]))
        return ENV.step(KEY, state((-0.7, -0.7)), jnp.zeros(2), params)[1].reward

    assert jax.jit(jax.grad(distance_cost))(0.7) == pytest.approx(-0.1 / np.sqrt(2), rel=1e-4)
