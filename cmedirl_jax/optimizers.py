"""Adam at a learning rate that is data, not a closure."""

from typing import Any

import jax
import optax

from cmedirl_jax.types import Numeric


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
