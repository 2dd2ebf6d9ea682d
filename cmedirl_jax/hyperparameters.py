"""Hyperparameters as leaves of a state."""

from typing import TypeVar

import jax
import jax.numpy as jnp

HParams = TypeVar("HParams")


def traced(hparams: HParams) -> HParams:
    """Convert the numbers to float32 arrays, so that every state has leaves of the same type."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)
