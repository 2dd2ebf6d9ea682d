"""Hyperparameters as leaves of a state, and an Adam whose learning rate is such a leaf."""

import functools
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import optax

from cmedirl_jax.types import Numeric

HParams = TypeVar("HParams")


def traced(hparams: HParams) -> HParams:
    """Convert the numbers to float32 arrays, so that every state has leaves of the same type."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)


def adam() -> optax.GradientTransformationExtraArgs:
    """Adam whose `update` takes `learning_rate=`, so that the rate can be a traced leaf."""
    moments = optax.scale_by_adam()
    return optax.GradientTransformationExtraArgs(
        moments.init, functools.partial(_update_adam, moments)
    )


def _update_adam(
    moments: optax.GradientTransformation,
    updates: Any,
    state: optax.OptState,
    params: Any = None,
    *,
    learning_rate: Numeric = 0.0,
    **extra_args: Any,
) -> tuple[Any, optax.OptState]:
    del extra_args
    directions, state = moments.update(updates, state, params)
    return jax.tree.map(lambda direction: -learning_rate * direction, directions), state
