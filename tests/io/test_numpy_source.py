"""What is written in numpy computes what JAX computes, or is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.io import numpy_source

TABLE = jnp.array([1.0, -2.0, 4.0])
OPERATIONS = {
    "arithmetic": lambda x: -(jnp.abs(x) ** 3) + jnp.square(x) / (1.0 + x**2) - jnp.sign(x),
    "transcendental": lambda x: jnp.exp(jnp.sin(x)) + jnp.log1p(x**2) + jnp.expm1(-jnp.cos(x)),
    "activations": lambda x: jax.nn.sigmoid(x) + jax.nn.softplus(x) + jax.nn.silu(x),
    "comparisons": lambda x: jnp.where((x > 0) & ~(x >= 1) | (x < -1), x, -jnp.inf),
    "reductions": lambda x: x / jnp.sum(x, -1, keepdims=True) + jnp.max(x, -1, keepdims=True),
    "softmax": lambda x: jax.nn.softmax(x, axis=-1),
    "shapes": lambda x: jnp.concatenate([x[:, 1:], x[:, :1]], axis=1).T.T,
    "einsum": lambda x: jnp.einsum("bi,bj->bij", x, x).sum(axis=2),
    "look-up": lambda x: jnp.arange(4.0)[jnp.argmax(x, axis=-1)],
    "rows out of range": lambda x: jnp.arange(6.0).at[jnp.int32(9 * x[:, 0])].get(mode="clip"),
    "window": lambda x: x[:, 1:3],
    "integers": lambda x: jnp.sum(x > 0, axis=1) * 2 + jnp.argmax(x, axis=1) % 2,
    "checkpoint": jax.checkpoint(lambda x: jnp.tanh(x)),
    "constants of its own": lambda x: x + jax.jit(lambda: jnp.arange(3.0) * TABLE)(),
    "norm": lambda x: x * jax.lax.rsqrt(jnp.mean(x**2, -1, keepdims=True) + 1e-3),
    "parts": lambda x: jnp.stack([*jnp.unstack(x, axis=1), *jnp.unstack(x[:, :1], axis=1)], axis=1),
    "uneven parts": lambda x: jnp.concatenate(jnp.split(x, [1], axis=1)[::-1], axis=1),
    "no batch": lambda x: jnp.broadcast_to(jnp.float32(jnp.nan), x.shape),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_in_numpy(name):
    x = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    source = numpy_source.write("operation", OPERATIONS[name], {"x": 3}, "A test.")
    scope = {}
    exec(source, scope)
    found = scope["operation"](x)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, OPERATIONS[name](x), rtol=1e-5, atol=1e-6)
    assert scope["operation"](x[:0]).shape[0] == 0
    with pytest.raises(ValueError, match="expected leading axes None and then 3"):
        scope["operation"](x[:, :2])


@pytest.mark.parametrize(
    ("operation", "said"),
    [
        (lambda x: jnp.sort(x, axis=-1), "no sort"),
        (lambda x: x.astype(jnp.bfloat16), "no bfloat16"),
        (lambda x: jnp.int32(x) // 2, "no division of integers"),
        (lambda x: jnp.take(TABLE, jnp.int32(x[:, 0])), "no gather that fills"),
    ],
)
def test_what_numpy_would_compute_otherwise_is_refused(operation, said):
    with pytest.raises(ValueError, match=f"numpy's file has {said}"):
        numpy_source.write("operation", operation, {"x": 3}, "A test.")


@pytest.mark.parametrize("name", ["np", "_v1", "a-b", "lambda"])
def test_names_that_the_file_cannot_have_are_refused(name):
    with pytest.raises(ValueError, match=r"no public name of Python|name of the file's own"):
        numpy_source.write("operation", lambda x: x, {name: 3}, "A test.")


def test_inputs_have_equal_leading_axes():
    scope = {}
    source = numpy_source.write("add", lambda x, y: x[:, 0] + y[:, 0], {"x": 1, "y": 2}, "A test.")
    exec(source, scope)
    assert scope["add"](np.ones(1), np.ones(2)) == 2.0
    with pytest.raises(ValueError, match=r"expected leading axes \(4,\) and then 2"):
        scope["add"](np.ones((4, 1)), np.ones((3, 2)))
