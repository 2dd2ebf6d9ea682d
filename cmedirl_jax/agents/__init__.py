"""The agent: DDPG, its behaviour policies and their densities, and its hot start."""

from cmedirl_jax.agents import behaviour, ddpg, densities, exploration, hot_start

__all__ = ["behaviour", "ddpg", "densities", "exploration", "hot_start"]
