"""The product of a dense layer, with a gradient that XLA's CPU backend computes fast.

The gradient of x W with respect to W is x^T g. XLA folds that transpose into the product, and its
CPU backend then takes a slower path. Here the transposed x is an array of its own.
"""

from typing import Any

import jax


def dot_general(
    x: jax.Array,
    kernel: jax.Array,
    dimension_numbers: Any,
    precision: jax.lax.PrecisionLike = None,
    preferred_element_type: Any = None,
) -> jax.Array:
    """x W for the `dot_general` of `flax.linen.Dense`: `[..., D]`, `[D, U]` -> `[..., U]`.

    The other arguments are those that a dense layer gives, and are not read.
    """
    del dimension_numbers, precision, preferred_element_type
    rows = x.reshape(-1, x.shape[-1])
    return _product(rows, kernel).reshape(*x.shape[:-1], kernel.shape[-1])


@jax.custom_jvp
def _product(rows: jax.Array, kernel: jax.Array) -> jax.Array:
    """`[N, D]`, `[D, U]` -> `[N, U]`."""
    return rows @ kernel


@_product.defjvp
def _product_jvp(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    rows, kernel = primals
    rows_tangent, kernel_tangent = tangents
    # Without the barrier XLA folds the transpose into the product of the gradient.
    columns = jax.lax.optimization_barrier(rows.T)
    of_kernel = jax.lax.dot_general(columns, kernel_tangent, (((0,), (0,)), ((), ())))
    return _product(rows, kernel), rows_tangent @ kernel + of_kernel
