"""Demonstrations as arrays that go through `jit`, for every method that uses them."""

from typing import NamedTuple

import numpy as np

from cmedirl_jax import checks
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.types import Array, Demonstrations, DemonstrationSubset, Transition


class HotStartData(NamedTuple):
    """A pool without its metadata, and the returns of its steps.

    Attributes:
        transition: leaves `[N, ...]`.
        discounted_return: `[N]` float32, the discounted return from each step to the end of its
            episode, times the agent's reward scale.
        episodes: where the pool's episodes lie.
    """

    transition: Transition
    discounted_return: Array
    episodes: DemonstrationSubset


def prepare(
    demonstrations: Demonstrations, discount: float = 0.99, reward_scale: float = 1.0
) -> HotStartData:
    """Prepare a pool (on the host, once) for an agent of this discount and reward scale.

    The returns are of the environment's reward. They end with the demonstration, even if the time
    limit cut it off.

    Args:
        demonstrations: the pool, one that `demonstrations.validate` accepts.
        discount: per environment step.
        reward_scale: factor on every reward.

    Raises:
        ValueError: if the pool is not valid, the discount is not between 0 and 1, or the scale not
            positive and finite.
    """
    demonstrations_lib.validate(demonstrations)
    checks.positive(reward_scale=reward_scale)
    returns = demonstrations_lib.discounted_returns(demonstrations, discount)
    return HotStartData(
        demonstrations.transition,
        (reward_scale * returns).astype(np.float32),
        demonstrations_lib.episodes(demonstrations),
    )
