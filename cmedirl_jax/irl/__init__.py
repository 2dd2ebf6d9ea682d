"""Maximum-entropy inverse reinforcement learning from samples (Algorithm 1), and comparators."""

from cmedirl_jax.irl import adversarial, base, controls, densities, objectives, regularisers
from cmedirl_jax.irl.adversarial import GAILHParams
from cmedirl_jax.irl.base import RewardInfo, RewardLearner, RewardState
from cmedirl_jax.irl.learner import IRLHParams, RewardParams, make

__all__ = [
    "GAILHParams",
    "IRLHParams",
    "RewardInfo",
    "RewardLearner",
    "RewardParams",
    "RewardState",
    "adversarial",
    "base",
    "controls",
    "densities",
    "make",
    "objectives",
    "regularisers",
]
