"""What rewards look at, and whether they agree."""

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.assess import importance
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.types import Transition

RNG = np.random.default_rng(0)


def steps(*leading):
    observation = RNG.normal(size=(*leading, 3)).astype(np.float32)
    action = RNG.normal(size=(*leading, 1)).astype(np.float32)
    zero = np.zeros(leading, np.float32)
    return Transition(observation, action, zero, observation, zero > 0)


def linear(params, observation, action):
    return jnp.concatenate([observation, action], axis=-1) @ params


def test_the_importance_of_independent_inputs_is_their_share_of_the_deviation():
    params = jnp.array([[1.0, 0.0, 0.0, 0.0], [3.0, 0.0, 4.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    found = importance.permutation(jax.random.key(0), Rewards(linear, params), steps(3, 20_000))
    expected = [[1.0, 0.0, 0.0, 0.0], [0.6, 0.0, 0.8, 0.0], [0.0, 0.0, 0.0, 0.0]]
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_rewards_agree_up_to_scale_and_a_constant():
    def pay(params, observation, action):
        return params[0] * observation[..., 0] + params[1] + params[2] * action[..., 0]

    params = jnp.array([[1.0, 0.0, 0.0], [5.0, 2.0, 0.0], [-2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    found = importance.disagreement(Rewards(pay, params), steps(20_000))
    np.testing.assert_allclose(found, found.T, atol=1e-6)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(found[0], [0.0, 0.0, 1.0, half], atol=0.01)
