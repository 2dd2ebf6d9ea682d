"""Arrays of different ranks, for programs that set `jax_numpy_rank_promotion` to "raise"."""

import jax
import jax.numpy as jnp

from cmedirl_jax.types import Array


def align(*arrays: Array) -> list[jax.Array]:
    """Put axes of size one before the arrays' own, so that all have as many: `[A]` -> `[1, A]`.

    NumPy's broadcasting does the same unasked, which that option forbids.
    """
    rank = max(map(jnp.ndim, arrays))
    return [jax.lax.broadcast_to_rank(array, rank) for array in arrays]
