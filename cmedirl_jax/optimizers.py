"""Hyperparameters as leaves of a state, and Adam at a learning rate that is such a leaf."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import optax

from cmedirl_jax.types import Numeric

HParams = TypeVar("HParams")


def traced(hparams: HParams) -> HParams:
    """The numbers as float32 arrays, so that a state has one type whoever made it."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)


def adam() -> optax.GradientTransformationExtraArgs:
    """Adam whose `update` takes `learning_rate=`, so that it can be a traced leaf of a state."""
    moments = optax.scale_by_adam()

    def update(
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

    return optax.GradientTransformationExtraArgs(moments.init, update)
