"""Demonstrations and their files, the replay buffer, and where the episodes lie in it."""

from cmedirl_jax.data import demonstrations, episodes, formats, hot_start_data, replay, validation

__all__ = ["demonstrations", "episodes", "formats", "hot_start_data", "replay", "validation"]
