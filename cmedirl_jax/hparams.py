"""Hyperparameters as data: leaves of a state, to vmap over or to change."""

from typing import TypeVar

import jax
import jax.numpy as jnp

HParams = TypeVar("HParams")


def traced(hparams: HParams) -> HParams:
    """The numbers as float32 arrays, so that a state has one type whoever made it."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)
