import jax
import numpy as np
import pytest

from cmedirl_jax import shaping

R_E, R_D = np.float32([-0.1, 100.0, 0.0]), np.float32([0.1, -0.05, 0.02])


def test_rewards_add_up():
    np.testing.assert_allclose(shaping.additive(R_E, R_D), R_E + R_D)


@pytest.mark.parametrize("weight", [0.0, 0.5, 2.0])
def test_the_weight_scales_the_learned_reward(weight):
    shaped = jax.jit(shaping.additive)(R_E, R_D, weight)
    np.testing.assert_allclose(shaped, R_E + weight * R_D, rtol=1e-6)
