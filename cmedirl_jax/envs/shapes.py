"""What the adapters of other libraries' tasks share."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

Reset = tuple[Any, jax.Array]
"""A first state, and its observation `[O]`."""


def cast_like(state: Any, like: Any) -> Any:
    """A state whose leaves have the types of another's: those of `reset` and `step` may differ."""

    def cast(leaf: Any, wanted: Any) -> jax.Array:
        leaf = jnp.asarray(leaf)
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return leaf
        return jax.lax.convert_element_type(leaf, wanted.dtype)

    return jax.tree.map(cast, state, like)


def fixed_starts(
    reset: Callable[[jax.Array, Any], Reset],
) -> Callable[[int, Any], Reset]:
    """Evaluation starts of fixed keys: `(count, params) -> (states, observations)`."""

    def starts(count: int, params: Any) -> Reset:
        keys = jax.random.split(jax.random.key(0), count)
        return jax.vmap(reset, in_axes=(0, None))(keys, params)

    return starts
