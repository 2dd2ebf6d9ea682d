"""Environments as pure functions."""

from cmedirl_jax.envs.base import Env, Step
from cmedirl_jax.envs.brax import from_brax
from cmedirl_jax.envs.gymnax import from_gymnax
from cmedirl_jax.envs.registry import ENVS, make, register
from cmedirl_jax.envs.validation import check

__all__ = ["ENVS", "Env", "Step", "check", "from_brax", "from_gymnax", "make", "register"]
