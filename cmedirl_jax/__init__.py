"""Continuous maximum-entropy deep inverse reinforcement learning with hot-started DDPG, in JAX."""

from cmedirl_jax import envs, irl, networks, tabular, training
from cmedirl_jax.agents import ddpg, exploration, hot_start
from cmedirl_jax.data import demonstrations, episodes, replay
from cmedirl_jax.io import checkpoint
from cmedirl_jax.irl import reward_batches as background
from cmedirl_jax.irl import rewards, shaping
from cmedirl_jax.training import evaluation, schedules, seeds
from cmedirl_jax.training.methods import METHODS, Method
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import EnvSpec, Network, RewardBatch, Transition

__all__ = [
    "METHODS",
    "EnvSpec",
    "Method",
    "Network",
    "RewardBatch",
    "Settings",
    "Transition",
    "background",
    "checkpoint",
    "ddpg",
    "demonstrations",
    "envs",
    "episodes",
    "evaluation",
    "exploration",
    "hot_start",
    "irl",
    "networks",
    "replay",
    "rewards",
    "schedules",
    "seeds",
    "shaping",
    "tabular",
    "training",
]
