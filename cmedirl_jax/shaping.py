"""How the learned reward joins the environment's."""

import chex


def additive(
    environment_reward: chex.Array, learned_reward: chex.Array, weight: chex.Numeric = 1.0
) -> chex.Array:
    """r* = r_e + weight r_D (Eq. 10, where the weight is 1). All `[...]`."""
    return environment_reward + weight * learned_reward
