"""What JAX's strict modes ask of arrays: equal ranks, and equal axes of variation in `shard_map`."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from cmedirl_jax.types import Array

Tree = TypeVar("Tree")


def align(*arrays: Array) -> list[jax.Array]:
    """Put axes of size one before the arrays' own, so that all have as many: `[A]` -> `[1, A]`.

    NumPy's broadcasting does the same unasked, which `jax_numpy_rank_promotion` "raise" forbids.
    """
    rank = max(map(jnp.ndim, arrays))
    return [jax.lax.broadcast_to_rank(array, rank) for array in arrays]


def vary(tree: Tree, *like: Any) -> Tree:
    """Mark arrays as varying over the mesh axes over which the leaves of `like` vary.

    A branch of `lax.cond`, or the start of a loop, that is a constant has to be marked so within a
    caller's `shard_map`. Elsewhere this returns `tree`.
    """
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return tree
    axes = frozenset().union(*map(_axes, jax.tree.leaves(like)))

    def mark(leaf: Any) -> jax.Array:
        return jax.lax.pcast(leaf, tuple(axes - _axes(leaf)), to="varying")

    return jax.tree.map(mark, tree)


def settle(body: Callable[..., Tree], start: Tree, *inputs: Any) -> Tree:
    """`start` of a loop as `vary` marks it, so that `body(start, *inputs)` varies no more than it.

    What varies may be closed over by `body`, which is therefore traced, within `shard_map` alone.
    """
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return start
    return vary(start, start, jax.make_jaxpr(body)(start, *inputs).out_avals)


def _axes(leaf: Any) -> frozenset:
    kind = leaf if isinstance(leaf, jax.core.AbstractValue) else jax.typeof(leaf)
    # Its name in JAX up to 0.10.1 and since.
    return kind.vma if hasattr(kind, "vma") else kind.manual_axis_type.varying
