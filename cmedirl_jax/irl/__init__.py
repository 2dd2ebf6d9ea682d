"""Maximum-entropy inverse reinforcement learning from samples (Algorithm 1)."""

from cmedirl_jax.irl.learner import IRLHParams, RewardInfo, RewardLearner, RewardState, make

__all__ = ["IRLHParams", "RewardInfo", "RewardLearner", "RewardState", "make"]
