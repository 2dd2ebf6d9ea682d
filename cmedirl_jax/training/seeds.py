"""Many independent seeds at once: vmapped in groups that fit the cache, on every device.

`vmap` over a hundred seeds streams all their parameters through memory at every step. Groups of a
few seeds, each run through its whole chunk of steps before the next begins, stay in the cache.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, modes

State = TypeVar("State")

GROUP_SIZES = ((range(4, 11), 128), (range(2, 3), 256))
"""Seeds per group whose states fit a core's cache, for networks narrower than so many units."""


def keys(key: jax.Array, count: int) -> jax.Array:
    """`[count]` keys; seed i's is `fold_in(key, i)`, whatever the count.

    Raises:
        ValueError: if the count is negative.
        TypeError: if it is not an integer.
    """
    checks.counts(count=count)
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, np.arange(count))


def group_size(seeds: int, devices: int = 1, hidden: Sequence[int] = (64, 64)) -> int:
    """How many seeds to vmap together, for the least padding; 1 for networks of 256 units or more.

    Args:
        seeds: how many seeds there are.
        devices: how many devices share them.
        hidden: units of each hidden layer.

    Raises:
        ValueError: if `seeds` or `devices` is not positive.
        TypeError: if one of them is not an integer.
    """
    checks.sizes(seeds=seeds, devices=devices)
    per_device = -(-seeds // devices)
    for sizes, width in GROUP_SIZES:
        if max(hidden, default=0) < width:
            if per_device < sizes.start:
                return per_device
            return min(sizes, key=lambda size: (-(-per_device // size) * size, -size))
    return 1


def padded(seeds: int, group: int, devices: int = 1) -> int:
    """The least number of seeds, at least `seeds`, that fills whole groups on every device.

    Raises:
        ValueError: if `seeds` is negative, or `group` or `devices` not positive.
        TypeError: if one of them is not an integer.
    """
    checks.counts(seeds=seeds)
    checks.sizes(group=group, devices=devices)
    block = group * devices
    return -(-seeds // block) * block


def map_groups(function: Callable[..., State], group: int) -> Callable[..., State]:
    """Map `function(seed_state, *shared)` over a leading axis of seeds, `group` of them at a time.

    Args:
        function: takes and returns one seed's pytree; further arguments are shared by all seeds.
        group: seeds per `vmap`; must divide the number of seeds.

    Raises:
        ValueError: if `group` is not positive; and, when called, if it does not divide the number
            of seeds, or the leaves have not that number in their leading axis.
        TypeError: if `group` is not an integer.
    """
    checks.sizes(group=group)

    def mapped(states, *shared):
        count = _whole_groups(states, group)
        grouped = jax.tree.map(lambda x: x.reshape(count // group, group, *x.shape[1:]), states)
        vmapped = jax.vmap(function, in_axes=(0, *(None for _ in shared)))
        result = jax.lax.map(lambda states: vmapped(states, *shared), grouped)
        return jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), result)

    return mapped


def step_groups(
    function: Callable[..., tuple[State, Any]], group: int
) -> Callable[..., tuple[State, Any]]:
    """Like `map_groups`, for the first groups alone and in place.

    How many groups is traced, so that seeds which have finished cost nothing once they lie behind
    those which have not. Under `jit` with the states donated, no second copy of them is held.

    Args:
        function: `(seed_state, *shared) -> (seed_state, output)`.
        group: seeds per `vmap`; must divide the number of seeds.

    Returns:
        `(states, groups [] int32, *shared) -> (states, outputs)`. The seeds past the first `groups`
        groups keep their states, and their outputs are zeros.

    Raises:
        ValueError: as `map_groups`.
        TypeError: if `group` is not an integer.
    """
    checks.sizes(group=group)

    def mapped(states, groups, *shared):
        count = _whole_groups(states, group)
        vmapped = jax.vmap(function, in_axes=(0, *(None for _ in shared)))

        def block(states, index):
            return jax.tree.map(
                lambda x: jax.lax.dynamic_slice_in_dim(x, index * group, group), states
            )

        def put(whole, part, index):
            return jax.tree.map(
                lambda x, y: jax.lax.dynamic_update_slice_in_dim(x, y, index * group, axis=0),
                whole,
                part,
            )

        # Traced once, though its shapes are needed before the loop: tracing takes seconds.
        jaxpr, shapes = jax.make_jaxpr(vmapped, return_shape=True)(block(states, 0), *shared)
        step = jax.extend.core.jaxpr_as_fun(jaxpr)

        def body(index, carry):
            states, outputs = carry
            flat = step(*jax.tree.leaves((block(states, index), *shared)))
            stepped, output = jax.tree.unflatten(jax.tree.structure(shapes), flat)
            return put(states, stepped, index), put(outputs, output, index)

        outputs = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), shapes[1])
        outputs = modes.vary(outputs, states, shared)
        return jax.lax.fori_loop(0, groups, body, (states, outputs))

    return mapped


def _whole_groups(states: Any, group: int) -> int:
    leading = sorted({jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(states)})
    if len(leading) != 1 or leading == [()]:
        raise ValueError(f"expected leaves with one leading axis of seeds, got {leading}")
    (count,) = leading[0]
    if count % group:
        raise ValueError(f"{count} seeds are not whole groups of {group}")
    return count


def sharding(devices: Sequence[Any]) -> jax.sharding.NamedSharding:
    """The leading axis split over `devices`, as `map_devices` leaves it."""
    mesh = jax.sharding.Mesh(np.asarray(devices), ("seeds",))
    return jax.sharding.NamedSharding(mesh, jax.P("seeds"))


def replicated(devices: Sequence[Any]) -> jax.sharding.NamedSharding:
    """A copy on each of `devices`, as `map_devices` shares its other arguments."""
    return jax.sharding.NamedSharding(sharding(devices).mesh, jax.P())


def map_devices(function: Callable[..., State], devices: Sequence[Any]) -> Callable[..., State]:
    """Split the leading axis of the first argument over `devices`; share the other arguments.

    Args:
        function: maps a block of seeds, as `map_groups` returns it.
        devices: each takes an equal share; their number must divide the number of seeds.
    """
    split, shared_spec = jax.P("seeds"), jax.P()

    def mapped(states, *shared):
        return jax.shard_map(
            function,
            mesh=sharding(devices).mesh,
            in_specs=(split, *(shared_spec for _ in shared)),
            out_specs=split,
            check_vma=False,
        )(states, *shared)

    return mapped
