import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.tabular import dynamics as dynamics_lib
from tests.support import mdps


@given(st.integers(0, 1000), st.booleans())
def test_expectations_and_distributions_are_each_others_transpose(seed, sparse):
    dense, reward, _, _ = mdps.random_mdp(seed)
    values = np.random.default_rng(seed).normal(size=4)
    with jax.enable_x64(True):
        dynamics = mdps.sparse(dense) if sparse else dense
        expected = np.asarray(dynamics_lib.expected_next(dynamics, jnp.asarray(values)))
        arriving = np.asarray(dynamics_lib.next_distribution(dynamics, jnp.asarray(reward)))
    np.testing.assert_allclose(expected, dense @ values, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(arriving @ values, np.sum(reward * expected), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("shape", [(4, 2), (3, 3), (4,)])
def test_dynamics_of_other_sizes_are_refused(shape):
    dense, _, _, _ = mdps.random_mdp(0)
    for dynamics in (dense, mdps.sparse(dense)):
        dynamics_lib.check(dynamics, (4, 3))
        with pytest.raises(ValueError, match=r"expected a reward \[S, A\] and dynamics"):
            dynamics_lib.check(dynamics, shape)
