"""Environments as pure functions."""

from cmedirl_jax.envs.base import Env, Step, check
from cmedirl_jax.envs.registry import make

__all__ = ["Env", "Step", "check", "make"]
