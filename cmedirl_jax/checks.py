"""Checks of shapes and dtypes while tracing, which cost nothing when the program runs."""

import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from cmedirl_jax.types import EnvSpec, Numeric, Transition

_KINDS = {
    jnp.floating: "floats",
    jnp.integer: "integers",
    jnp.unsignedinteger: "unsigned integers",
    jnp.bool_: "bool",
}


def transition_shapes(
    spec: EnvSpec, transition: Transition, leading: tuple[int, ...], name: str
) -> None:
    """Check that every leaf has the axes `leading` and then `spec`'s, and its kind of dtype.

    Raises:
        ValueError: with the shapes expected and found.
        TypeError: naming the leaf and its dtype.
    """
    expected = {
        "observation": (*leading, spec.observation_dim),
        "action": (*leading, spec.action_dim),
        "reward": leading,
        "next_observation": (*leading, spec.observation_dim),
        "terminated": leading,
    }
    found = {field: jnp.shape(leaf) for field, leaf in transition._asdict().items()}
    if found != expected:
        raise ValueError(f"{name}: expected leaves of shape {expected}, got {found}")
    for field, leaf in transition._asdict().items():
        kind(f"{name}: {field}", leaf, jnp.bool_ if field == "terminated" else jnp.floating)


def pairs(spec: EnvSpec, observation: Any, action: Any = None) -> None:
    """Check observations `[..., O]` and, if given, actions `[..., A]`, of the same leading axes.

    Raises:
        ValueError: with the shapes found.
        TypeError: if they are not floats.
    """
    found = {"observation": jnp.shape(observation)}
    leading, expected = found["observation"][:-1], {"observation": spec.observation_dim}
    if action is not None:
        found["action"], expected["action"] = jnp.shape(action), spec.action_dim
    if found != {name: (*leading, dim) for name, dim in expected.items()}:
        raise ValueError(f"expected the same leading axes and then {expected}, got {found}")
    kind("observation", observation, jnp.floating)
    if action is not None:
        kind("action", action, jnp.floating)


def shape(name: str, array: Any, expected: tuple[int, ...]) -> None:
    """Check a shape.

    Raises:
        ValueError: with both shapes.
    """
    if jnp.shape(array) != expected:
        raise ValueError(f"{name}: expected shape {expected}, got {jnp.shape(array)}")


def kind(name: str, array: Any, expected: Any) -> None:
    """Check that a dtype is of a kind: `jnp.floating`, `integer`, `unsignedinteger` or `bool_`.

    Raises:
        TypeError: naming the dtype.
    """
    dtype = jnp.result_type(array)
    if not jnp.issubdtype(dtype, expected):
        raise TypeError(f"{name}: expected {_KINDS[expected]}, got {dtype}")


def vectors(name: str, array: Any, size: int) -> None:
    """Check vectors of floats, `[..., size]`, with any leading axes.

    Raises:
        ValueError: with the shape expected and found.
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
    """Check that static counts, of which there may be none, are integers that are not negative.

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


def shares(**named: Numeric) -> None:
    """Check that numbers are between 0 and 1. Arrays pass: their values may not be known.

    Raises:
        ValueError: naming the first that is not.
    """
    for name, share in named.items():
        if _known(share) and not 0.0 <= share <= 1.0:
            raise ValueError(f"{name} must be between 0 and 1, got {share}")


def positive(**named: Numeric) -> None:
    """Check that numbers are positive and finite. Arrays pass: their values may not be known.

    Raises:
        ValueError: naming the first that is not.
    """
    for name, number in named.items():
        if _known(number) and not 0.0 < number < math.inf:
            raise ValueError(f"{name} must be positive and finite, got {number}")


def _known(number: Any) -> bool:
    return isinstance(number, int | float | np.number)


def env_spec(spec: EnvSpec) -> None:
    """Check that a specification agrees with itself.

    Raises:
        ValueError: naming the field and what it must be.
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
