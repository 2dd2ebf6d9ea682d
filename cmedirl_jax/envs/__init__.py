"""Environments as pure functions."""

from cmedirl_jax.envs.base import Env, Step, check
from cmedirl_jax.envs.registry import ENVS, make, register

__all__ = ["ENVS", "Env", "Step", "check", "make", "register"]
