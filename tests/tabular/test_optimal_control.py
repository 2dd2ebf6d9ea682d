import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import tabular
from cmedirl_jax.tabular import Stop
from tests.support import mdps


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("absorbing", [False, True])
def test_no_deterministic_policy_is_better(absorbing):
    dynamics, reward, _, ends = mdps.random_mdp(0, 3, 2, absorbing=absorbing)
    optimum = tabular.value_iteration(
        dynamics, jnp.asarray(reward), discount=0.9, absorbing=ends, stop=Stop(1e-14)
    )
    alive = np.ones(3) if ends is None else ~ends
    best = np.full(3, -np.inf)
    for policy in np.ndindex(2, 2, 2):
        moves = dynamics[range(3), policy] * alive[:, None]
        value = np.linalg.solve(np.eye(3) - 0.9 * moves, reward[range(3), policy] * alive)
        best = np.maximum(best, value)
    np.testing.assert_allclose(optimum.values, best, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(optimum.action_values, reward + 0.9 * dynamics @ best, rtol=1e-10)


def test_a_finite_horizon_is_the_limit_of_low_temperature():
    dynamics, reward, _, ends = mdps.random_mdp(1, absorbing=True)
    kwargs = {"discount": 1.0, "horizon": 6, "absorbing": ends}
    hard = tabular.value_iteration(dynamics, jnp.asarray(reward), **kwargs)
    soft = tabular.soft_value_iteration(dynamics, jnp.asarray(reward), temperature=1e-4, **kwargs)
    np.testing.assert_allclose(hard.values, soft.values, atol=1e-3)
    np.testing.assert_allclose(hard.action_values, soft.action_values[0], atol=1e-3)
    assert hard.values.shape == (6, 4)
