import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.tabular import Stop
from cmedirl_jax.tabular.fixed_point import iterate, solve

MATRIX = np.array([[0.5, 0.2], [0.1, 0.3]])


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def affine(offset):
    return lambda x: MATRIX @ x + offset


def test_the_fixed_point_of_an_affine_map_solves_its_equation():
    offset = jnp.array([1.0, -2.0])
    point, change = iterate(affine(offset), jnp.zeros(2), Stop(tolerance=1e-14))
    np.testing.assert_allclose(point, np.linalg.solve(np.eye(2) - MATRIX, offset), rtol=1e-12)
    assert change <= 1e-14


def test_iterations_are_limited():
    point, change = iterate(affine(jnp.ones(2)), jnp.zeros(2), Stop(iterations=2))
    np.testing.assert_allclose(point, MATRIX @ np.ones(2) + 1.0)
    assert change > 0.1


@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_the_derivative_is_that_of_the_equations_solution(jacobian):
    def point(offset):
        return solve(affine(offset), jnp.zeros(2), Stop(tolerance=1e-14))[0]

    expected = np.linalg.inv(np.eye(2) - MATRIX)
    np.testing.assert_allclose(jacobian(point)(jnp.array([1.0, -2.0])), expected, rtol=1e-12)
