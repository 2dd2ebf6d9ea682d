"""Environments as pure functions."""

from cmedirl_jax.envs.base import Env, Step
from cmedirl_jax.envs.registry import make

__all__ = ["Env", "Step", "make"]
