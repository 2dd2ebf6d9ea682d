"""Continuous maximum-entropy deep inverse reinforcement learning with hot-started DDPG, in JAX."""

from cmedirl_jax import (
    checkpoint,
    ddpg,
    demonstrations,
    envs,
    evaluation,
    exploration,
    hot_start,
    irl,
    networks,
    replay,
    rewards,
    schedules,
    seeds,
    shaping,
    tabular,
    training,
)
from cmedirl_jax.methods import METHODS, Method, Settings
from cmedirl_jax.types import EnvSpec, Network, Transition

__all__ = [
    "METHODS",
    "EnvSpec",
    "Method",
    "Network",
    "Settings",
    "Transition",
    "checkpoint",
    "ddpg",
    "demonstrations",
    "envs",
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
