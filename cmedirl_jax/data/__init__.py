"""Demonstrations, the replay buffer, and where the episodes lie in it."""

from cmedirl_jax.data import demonstrations, episodes, replay

__all__ = ["demonstrations", "episodes", "replay"]
