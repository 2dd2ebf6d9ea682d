"""How the learned reward joins the environment's."""

import jax

from cmedirl_jax.types import Numeric


def additive(
    environment_reward: jax.Array, learned_reward: jax.Array, weight: Numeric = 1.0
) -> jax.Array:
    """r* = r_e + weight r_D (Eq. 10, where the weight is 1). All `[...]`."""
    return environment_reward + weight * learned_reward
