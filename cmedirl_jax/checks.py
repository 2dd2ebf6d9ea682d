"""Checks of shapes and dtypes while tracing, which cost nothing when the program runs."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from cmedirl_jax.types import EnvSpec, Transition


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
    """Check that a dtype is of a kind: `jnp.floating`, `jnp.integer` or `jnp.bool_`.

    Raises:
        TypeError: naming the dtype.
    """
    dtype = jnp.result_type(array)
    if not jnp.issubdtype(dtype, expected):
        words = {jnp.floating: "floats", jnp.integer: "integers", jnp.bool_: "bool"}[expected]
        raise TypeError(f"{name}: expected {words}, got {dtype}")


def sizes(**named: int) -> None:
    """Check that static sizes are positive.

    Raises:
        ValueError: naming the first that is not.
    """
    for name, size in named.items():
        if size < 1:
            raise ValueError(f"{name} must be at least 1, got {size}")


def env_spec(spec: EnvSpec) -> None:
    """Check that a specification agrees with itself.

    Raises:
        ValueError: naming the field and what it must be.
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
