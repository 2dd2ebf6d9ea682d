"""Checks of arguments by name.

They run while tracing or on the host, and cost nothing in a compiled program. Shapes and
dtypes are always checked; values where they are known on the host, so those of traced arrays pass.
"""

import math
import operator
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import export

from cmedirl_jax import ranges
from cmedirl_jax.ranges import Range
from cmedirl_jax.types import Array, EnvSpec, Numeric, Transition

LARGEST_ARRAY = 2**28
"""The most numbers of an array whose size is a power of the dimensions: 1 GiB in float32."""

_KINDS = {
    jnp.floating: "floats",
    jnp.integer: "integers",
    jnp.unsignedinteger: "unsigned integers",
    jnp.bool_: "bool",
}


def transition_shapes(
    spec: EnvSpec, transition: Transition, leading: tuple[int, ...], name: str
) -> None:
    """Check the shapes and dtypes of a transition.

    Args:
        spec: gives the last axes.
        transition: the transition.
        leading: the axes in front of them.
        name: of the argument, for the message.

    Raises:
        ValueError: with the shapes expected and given.
        TypeError: naming the leaf and its dtype.
    """
    expected = {
        "observation": (*leading, spec.observation_dim),
        "action": (*leading, spec.action_dim),
        "reward": leading,
        "next_observation": (*leading, spec.observation_dim),
        "terminated": leading,
    }
    shapes = {field: jnp.shape(leaf) for field, leaf in transition._asdict().items()}
    if shapes != expected:
        raise ValueError(f"{name}: expected leaves of shape {expected}, got {shapes}")
    for field, leaf in transition._asdict().items():
        kind(f"{name}: {field}", leaf, jnp.bool_ if field == "terminated" else jnp.floating)


def pairs(spec: EnvSpec, observation: Any, action: Any = None) -> None:
    """Check observations `[..., O]` and, if given, actions `[..., A]`, of the same leading axes.

    Raises:
        ValueError: with the shapes given.
        TypeError: if they are not floats.
    """
    shapes, dims = {"observation": jnp.shape(observation)}, {"observation": spec.observation_dim}
    if action is not None:
        shapes["action"], dims["action"] = jnp.shape(action), spec.action_dim
    leading = shapes["observation"][:-1]
    if shapes != {name: (*leading, dim) for name, dim in dims.items()}:
        raise ValueError(f"expected the same leading axes and then {dims}, got {shapes}")
    kind("observation", observation, jnp.floating)
    if action is not None:
        kind("action", action, jnp.floating)


def shape(name: str, array: Any, expected: tuple[int, ...]) -> None:
    """Check a shape.

    Raises:
        ValueError: with the shapes expected and given.
    """
    if jnp.shape(array) != expected:
        raise ValueError(f"{name}: expected shape {expected}, got {jnp.shape(array)}")


def kind(name: str, array: Any, expected: Any) -> None:
    """Check a dtype's kind: `jnp.floating`, `jnp.integer`, `jnp.unsignedinteger` or `jnp.bool_`.

    Raises:
        TypeError: with the kind expected and the dtype given.
    """
    dtype = jnp.result_type(array)
    if not jnp.issubdtype(dtype, expected):
        raise TypeError(f"{name}: expected {_KINDS[expected]}, got {dtype}")


def vectors(name: str, array: Any, size: int) -> None:
    """Check vectors of floats, `[..., size]`, with any leading axes.

    Raises:
        ValueError: with the shapes expected and given.
        TypeError: if they are not floats.
    """
    shape(name, array, (*jnp.shape(array)[:-1], size))
    kind(name, array, jnp.floating)


def sizes(**named: Numeric) -> None:
    """Check that static sizes are positive integers.

    Raises:
        ValueError: naming the first that is below 1.
        TypeError: naming the first that is a float.
    """
    _at_least(1, named)


def counts(**named: Numeric) -> None:
    """Check that static counts are integers and not negative.

    Raises:
        ValueError: naming the first that is below 0.
        TypeError: naming the first that is a float.
    """
    _at_least(0, named)


def _at_least(low: int, named: Mapping[str, Any]) -> None:
    for name, size in named.items():
        if not ranges.known(size):
            continue
        try:
            number = operator.index(size)
        except TypeError:
            raise TypeError(f"{name}: expected an integer, got {size}") from None
        if number < low:
            raise ValueError(f"{name} must be at least {low}, got {size}")


def array_size(name: str, shape: Sequence[int], remedy: str) -> None:
    """Check that an array whose size is a power of the dimensions has at most `LARGEST_ARRAY`.

    Args:
        name: of the array, for the message.
        shape: its shape, before it is made; sizes that `jax.export` leaves open do not count.
        remedy: which option to change.

    Raises:
        ValueError: with its size and the remedy.
    """
    # Exact, and printable where it is beyond a float.
    size = Decimal(math.prod(int(size) for size in shape if not export.is_symbolic_dim(size)))
    if size > LARGEST_ARRAY:
        raise ValueError(
            f"{name} would be {size:.3g} numbers ({size / 2**28:.3g} GiB in float32), "
            f"more than 2^28: {remedy}"
        )


def shares(**named: Numeric | Array) -> None:
    """Check that numbers are between 0 and 1.

    Raises:
        ValueError: naming the first that is not.
    """
    within(ranges.SHARE, **named)


def positive(**named: Numeric | Array) -> None:
    """Check that numbers are positive and finite.

    Raises:
        ValueError: naming the first that is not.
    """
    within(ranges.POSITIVE, **named)


def within(interval: Range, **named: Numeric | Array) -> None:
    """Check that numbers, or all entries of arrays, lie in an interval.

    Raises:
        ValueError: naming the first that does not, what it must be, what it is and where.
    """
    for name, values in named.items():
        if wrong := ranges.complaint(interval, values):
            raise ValueError(f"{name} {wrong}")


def indices(size: int, **named: Array) -> None:
    """Check that integers index an axis of length `size`, from its beginning.

    Raises:
        ValueError: naming the first that is negative or not below `size`.
        TypeError: if they are not integers.
    """
    for name, values in named.items():
        kind(name, values, jnp.integer)
        within(Range(0, size - 1, f"at least 0 and below {size}"), **{name: values})


def env_spec(spec: EnvSpec) -> None:
    """Check that a specification does not contradict itself.

    Raises:
        ValueError: naming the field and what it has to be.
        TypeError: naming a size that is not an integer, or a bound that is not an array of float32.
    """
    sizes(
        **{
            f"{spec.id}: {name}": getattr(spec, name)
            for name in ("observation_dim", "action_dim", "max_episode_steps")
        }
    )
    for of, dim in (("observation", spec.observation_dim), ("action", spec.action_dim)):
        low, high = (getattr(spec, f"{of}_{end}") for end in ("low", "high"))
        for name, bound in ((f"{spec.id}: {of}_low", low), (f"{spec.id}: {of}_high", high)):
            if not isinstance(bound, np.ndarray):
                found = type(bound).__name__
                raise TypeError(f"{name}: expected a numpy array of float32, got a {found}")
            shape(name, bound, (dim,))
            # Without jax_enable_x64, JAX reads float64 as float32.
            if jnp.result_type(bound) != jnp.float32:
                raise TypeError(f"{name}: expected float32, got {bound.dtype}")
        # Observations may be unbounded; actions are squashed onto their bounds.
        if of == "action" and not (np.abs([low, high]) <= ranges.FINITE.high).all():
            raise ValueError(f"{spec.id}: action bounds must be finite, got {low} and {high}")
        if not np.all(np.less(low, high)):
            raise ValueError(f"{spec.id}: {of}_low must be below {of}_high, got {low} and {high}")
