"""Checks of shapes while tracing."""

import jax.numpy as jnp

from cmedirl_jax.types import EnvSpec, Transition


def transition_shapes(
    spec: EnvSpec, transition: Transition, leading: tuple[int, ...], name: str
) -> None:
    """Check that every leaf has the axes `leading` and then `spec`'s.

    Raises:
        ValueError: with the shapes expected and found.
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
