"""Tasks: environments as pure functions, and Gymnasium's, both ways.

A task is an environment with its specification (name, bounds, time limit) and, in JAX, its default
parameters: an `Env`, or a `HostEnv` that is stepped on the host. Arguments call a task `env`.
"Environment" alone is what an agent acts in: environment steps, the environment's reward r_e.
"""

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
