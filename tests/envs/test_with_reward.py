"""A task in JAX that pays a learned reward."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs

ENV = envs.make("MountainCarContinuous-v0")


def reward(params, observation, action):
    return params * (observation[0] + action[0])


def test_the_reward_is_of_the_state_before_and_the_action_within_its_bounds():
    paying = envs.with_reward(ENV, reward, jnp.float32(2.0))
    envs.check(paying, steps=50)
    added = envs.with_reward(ENV, reward, jnp.float32(2.0), mode="add")
    pay, add, step_alone = (jax.jit(env.step) for env in (paying, added, ENV))
    state, observation = paying.reset(jax.random.key(0), paying.default_params)
    params = paying.default_params._replace(reward=jnp.float32(3.0))
    for force in (0.5, 7.0):
        action = np.float32([force])
        after, step = pay(jax.random.key(1), state, action, params)
        own = step_alone(jax.random.key(1), state.env, action, ENV.default_params)[1]
        position = np.asarray(observation)[0]
        np.testing.assert_allclose(step.reward, 3.0 * (position + min(force, 1.0)))
        np.testing.assert_array_equal(step.observation, own.observation)
        both = add(jax.random.key(1), state, action, params)[1].reward
        np.testing.assert_allclose(both, step.reward + own.reward, rtol=1e-6)
        state, observation = after, step.observation


def test_another_mode_is_refused():
    with pytest.raises(ValueError, match="mode: 'times' is none of replace, add"):
        envs.with_reward(ENV, reward, mode="times")
