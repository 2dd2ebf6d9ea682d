"""Adam at a learning rate that is data, not a closure."""

import chex
import jax
import optax


def adam() -> optax.GradientTransformationExtraArgs:
    """Adam whose `update` takes `learning_rate=`, so that it can be a traced leaf of a state."""
    moments = optax.scale_by_adam()

    def update(updates, state, params=None, *, learning_rate: chex.Numeric, **extra_args):
        del extra_args
        directions, state = moments.update(updates, state, params)
        return jax.tree.map(lambda direction: -learning_rate * direction, directions), state

    return optax.GradientTransformationExtraArgs(moments.init, update)
