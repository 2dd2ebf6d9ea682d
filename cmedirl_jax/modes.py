"""What strict modes of JAX ask of arrays: equal ranks, and to vary alike within `shard_map`."""

from collections.abc import Callable, Iterable
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

    A caller's `shard_map` asks that of a branch's result, or of a loop's start, that is constant.
    Elsewhere `tree` is returned as it is.
    """
    return _vary(tree, map(jax.typeof, jax.tree.leaves(like))) if _in_shard_map() else tree


def settle(body: Callable[..., Tree], start: Tree, *inputs: Any) -> Tree:
    """The start of a loop, marked as varying as much as `body(start, *inputs)` does.

    Within `shard_map` this traces `body`, which may close over what varies.
    """
    if not _in_shard_map():
        return start
    after = jax.make_jaxpr(body)(start, *inputs).out_avals
    return _vary(start, [*map(jax.typeof, jax.tree.leaves(start)), *after])


def _in_shard_map() -> bool:
    return bool(jax.sharding.get_abstract_mesh().manual_axes)


def _vary(tree: Tree, kinds: Iterable[Any]) -> Tree:
    axes = frozenset().union(*map(_axes, kinds))

    def mark(leaf: Any) -> jax.Array:
        return jax.lax.pcast(leaf, tuple(axes - _axes(jax.typeof(leaf))), to="varying")

    return jax.tree.map(mark, tree)


def _axes(kind: Any) -> frozenset[str]:
    """The mesh axes over which an array of this type varies; `vma` is their earlier name."""
    return kind.vma if hasattr(kind, "vma") else kind.manual_axis_type.varying
