"""Checks of arguments by name. They run while tracing and cost nothing in a compiled program."""

import math
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any

import jax.numpy as jnp
import numpy as np

from cmedirl_jax.types import EnvSpec, Numeric, Transition

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


def sizes(**named: int) -> None:
    """Check that static sizes are positive integers.

    Raises:
        ValueError: naming the first that is below 1.
        TypeError: naming the first that is a float.
    """
    _at_least(1, named)


def counts(**named: int) -> None:
    """Check that static counts are integers and not negative.

    Raises:
        ValueError: naming the first that is below 0.
        TypeError: naming the first that is a float.
    """
    _at_least(0, named)


def _at_least(low: int, named: Mapping[str, int]) -> None:
    for name, size in named.items():
        if isinstance(size, float | np.floating):
            raise TypeError(f"{name}: expected an integer, got {size}")
        if _known(size) and size < low:
            raise ValueError(f"{name} must be at least {low}, got {size}")


def array_size(name: str, shape: Sequence[int], remedy: str) -> None:
    """Check that an array whose size is a power of the dimensions has at most `LARGEST_ARRAY`.

    Args:
        name: of the array, for the message.
        shape: its shape, before it is made.
        remedy: which option to change.

    Raises:
        ValueError: with its size and the remedy.
    """
    # Exact, and printable where it is beyond a float.
    size = Decimal(math.prod(map(int, shape)))
    if size > LARGEST_ARRAY:
        raise ValueError(
            f"{name} would be {size:.3g} numbers ({size / 2**28:.3g} GiB in float32), "
            f"more than 2^28: {remedy}"
        )


def shares(**named: Numeric) -> None:
    """Check that numbers are between 0 and 1. Arrays pass, as their values may be unknown.

    Raises:
        ValueError: naming the first that is not.
    """
    for name, share in named.items():
        if _known(share) and not 0.0 <= share <= 1.0:
            raise ValueError(f"{name} must be between 0 and 1, got {share}")


def positive(**named: Numeric) -> None:
    """Check that numbers are positive and finite. Arrays pass, as their values may be unknown.

    Raises:
        ValueError: naming the first that is not.
    """
    for name, number in named.items():
        if _known(number) and not 0.0 < number < math.inf:
            raise ValueError(f"{name} must be positive and finite, got {number}")


def _known(number: Any) -> bool:
    """Whether it is a number on the host, not an array that may be traced."""
    return isinstance(number, int | float | np.number)


def env_spec(spec: EnvSpec) -> None:
    """Check that a specification does not contradict itself.

    Raises:
        ValueError: naming the field and what it has to be.
        TypeError: naming a size that is a float.
    """
    sizes(
        **{
            f"{spec.id}: {name}": getattr(spec, name)
            for name in ("observation_dim", "action_dim", "max_episode_steps")
        }
    )
    for of, dim in (("observation", spec.observation_dim), ("action", spec.action_dim)):
        low, high = (getattr(spec, f"{of}_{end}") for end in ("low", "high"))
        shape(f"{spec.id}: {of}_low", low, (dim,))
        shape(f"{spec.id}: {of}_high", high, (dim,))
        # Observations may be unbounded; actions are squashed onto their bounds.
        if of == "action" and not np.isfinite([low, high]).all():
            raise ValueError(f"{spec.id}: action bounds must be finite, got {low} and {high}")
        if not np.all(np.less(low, high)):
            raise ValueError(f"{spec.id}: {of}_low must be below {of}_high, got {low} and {high}")
