"""Fixed points of contractions, differentiable by the implicit function theorem."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import checks, modes, ranges
from cmedirl_jax.types import Numeric


class Stop(NamedTuple):
    """When an iteration ends.

    Attributes:
        tolerance: largest change of an entry at the last iteration, relative to the largest entry
            (or to 1, if that is larger). The remaining error is at most discount / (1 - discount)
            times that.
        iterations: largest number of iterations.
    """

    tolerance: Numeric = 1e-6
    iterations: Numeric = 10_000


def iterate(
    function: Callable[[jax.Array], jax.Array], guess: jax.Array, stop: Stop
) -> tuple[jax.Array, jax.Array]:
    """Apply `function` `[...]` -> `[...]` until `stop`: the point, and the last relative change.

    Raises:
        ValueError: if the tolerance is negative or not finite, or there is no iteration.
        TypeError: if the number of iterations is not an integer.
    """
    checks.within(ranges.NOT_NEGATIVE, tolerance=stop.tolerance)
    checks.sizes(iterations=stop.iterations)

    def going(carry):
        _, change, count = carry
        return (change > stop.tolerance) & (count < stop.iterations)

    def advance(carry):
        before, _, count = carry
        after = function(before)
        change = jnp.max(jnp.abs(after - before)) / jnp.maximum(1.0, jnp.max(jnp.abs(after)))
        return after, change, count + 1

    start = (guess, jnp.full((), jnp.inf, guess.dtype), jnp.zeros((), jnp.int32))
    point, change, _ = jax.lax.while_loop(going, advance, modes.settle(advance, start))
    return point, change


def solve(
    function: Callable[[jax.Array], jax.Array], guess: jax.Array, stop: Stop
) -> tuple[jax.Array, jax.Array]:
    """Like `iterate`, and differentiable by what `function` closes over."""

    def tangent(linear: Callable[[jax.Array], jax.Array], value: jax.Array) -> jax.Array:
        # `linear` is I - dF: its inverse is the fixed point of x -> value + dF x.
        def invert(matvec: Callable[[jax.Array], jax.Array], value: jax.Array) -> jax.Array:
            return iterate(lambda x: value + x - matvec(x), value, stop)[0]

        return jax.lax.custom_linear_solve(linear, value, invert, transpose_solve=invert)

    return jax.lax.custom_root(
        lambda x: x - function(x),
        modes.settle(function, guess),
        lambda _, guess: iterate(function, guess, stop),
        tangent,
        has_aux=True,
    )
