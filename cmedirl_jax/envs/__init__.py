"""Tasks: environments as pure functions, and Gymnasium's, both ways."""

from cmedirl_jax.envs import wrappers
from cmedirl_jax.envs.base import Env, Step
from cmedirl_jax.envs.brax import from_brax
from cmedirl_jax.envs.gymnasium_env import to_gymnasium
from cmedirl_jax.envs.gymnasium_vector import to_gymnasium_vector
from cmedirl_jax.envs.gymnax import from_gymnax
from cmedirl_jax.envs.host import HostEnv, from_gymnasium
from cmedirl_jax.envs.registration import GYMNASIUM_NAMESPACE
from cmedirl_jax.envs.registry import ENVS, find, make, register, split_id
from cmedirl_jax.envs.validation import check
from cmedirl_jax.envs.with_reward import with_reward

__all__ = [
    "ENVS",
    "GYMNASIUM_NAMESPACE",
    "Env",
    "HostEnv",
    "Step",
    "check",
    "find",
    "from_brax",
    "from_gymnasium",
    "from_gymnax",
    "make",
    "register",
    "split_id",
    "to_gymnasium",
    "to_gymnasium_vector",
    "with_reward",
    "wrappers",
]
