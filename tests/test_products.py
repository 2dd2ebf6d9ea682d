import re

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import products

NUMBERS = (((1,), (0,)), ((), ()))


def arrays(*leading, inputs=5, units=3):
    rng = np.random.default_rng(0)
    return rng.normal(size=(*leading, inputs)).astype("f"), rng.normal(size=(inputs, units)).astype(
        "f"
    )


def product(x, kernel):
    return products.dot_general(x, kernel, NUMBERS)


@pytest.mark.parametrize("leading", [(), (1,), (7,), (2, 4), (0,)])
def test_value_and_gradients_are_those_of_the_product(leading):
    x, kernel = arrays(*leading)
    weights = np.random.default_rng(1).normal(size=(*leading, 3)).astype("f")

    @jax.jit
    def value_and_gradients(x, kernel):
        value, pullback = jax.vjp(product, x, kernel)
        return value, *pullback(weights)

    value, of_x, of_kernel = value_and_gradients(x, kernel)
    exact = np.float64(x), np.float64(kernel), np.float64(weights)
    np.testing.assert_allclose(value, exact[0] @ exact[1], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(of_x, exact[2] @ exact[1].T, rtol=1e-5, atol=1e-6)
    expected = exact[0].reshape(-1, 5).T @ exact[2].reshape(-1, 3)
    np.testing.assert_allclose(of_kernel, expected, rtol=1e-5, atol=1e-6)


def test_higher_derivatives_and_forward_mode():
    x, kernel = arrays(4)

    def loss(x, kernel):
        return jnp.sum(jnp.tanh(product(x, kernel)))

    def plain(x, kernel):
        return jnp.sum(jnp.tanh(x @ kernel))

    for derivative in (jax.hessian, jax.jacfwd, lambda f, n: jax.jacrev(jax.grad(f, n), n)):
        for argument in (0, 1):
            ours, theirs = (jax.jit(derivative(f, argument)) for f in (loss, plain))
            chex.assert_trees_all_close(ours(x, kernel), theirs(x, kernel), rtol=1e-5, atol=1e-6)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="of XLA's CPU backend")
def test_no_product_contracts_the_rows():
    """XLA's CPU backend is slow where the first operand's rows are contracted."""
    x, kernel = (jnp.stack([array] * 2) for array in arrays(8))

    def contracted(function):
        grads = jax.jit(jax.vmap(jax.grad(lambda x, w: jnp.sum(jnp.tanh(function(x, w))), 1)))
        text = grads.lower(x, kernel).compile().as_text()
        return re.findall(r"lhs_contracting_dims=\{(\d)\}", text)

    assert "1" in contracted(jnp.matmul)
    assert set(contracted(product)) == {"2"}
