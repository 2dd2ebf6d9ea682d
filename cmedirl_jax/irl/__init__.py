"""Maximum-entropy inverse reinforcement learning from samples (Algorithm 1), and comparators."""

from cmedirl_jax.irl import (
    base,
    controls,
    gail,
    objectives,
    regularisers,
    reward_batches,
    rewards,
    shaping,
)
from cmedirl_jax.irl.base import RewardInfo, RewardLearner, RewardState
from cmedirl_jax.irl.gail import GAILHParams
from cmedirl_jax.irl.learner import IRLHParams, RewardParams, make

__all__ = [
    "GAILHParams",
    "IRLHParams",
    "RewardInfo",
    "RewardLearner",
    "RewardParams",
    "RewardState",
    "base",
    "controls",
    "gail",
    "make",
    "objectives",
    "regularisers",
    "reward_batches",
    "rewards",
    "shaping",
]
