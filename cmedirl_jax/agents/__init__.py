"""The agent: DDPG, its behaviour policies and their densities, and its hot start."""

from cmedirl_jax.agents import ddpg, densities, exploration, hot_start

__all__ = ["ddpg", "densities", "exploration", "hot_start"]
