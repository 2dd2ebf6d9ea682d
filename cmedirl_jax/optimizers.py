"""An Adam whose learning rate is an argument of its update."""

import functools
from typing import Any

import jax
import optax

from cmedirl_jax.types import Numeric


def adam() -> optax.GradientTransformationExtraArgs:
    """Adam whose `update` takes `learning_rate=`, so that the rate can be a traced leaf.

    Without `learning_rate=` the updates are zero.
    """
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
