"""Runs of many seeds that are never lost, and what they have learned."""

from cmedirl_jax.runs.load import load_policy, load_reward

__all__ = ["load_policy", "load_reward"]
