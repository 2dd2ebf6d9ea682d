"""Tasks of this library under names that `gymnasium.make` knows.

    gymnasium.make("cmedirl_jax:cmedirl_jax/Pendulum-v1")

Gymnasium has had no plugins since 1.0: a module registers its tasks when it is imported, which the
part of a name before the colon asks for.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from cmedirl_jax.envs import mountain_car, pendulum
from cmedirl_jax.envs.gymnasium_env import to_gymnasium
from cmedirl_jax.envs.gymnasium_vector import to_gymnasium_vector
from cmedirl_jax.envs.registry import make

NAMESPACE = "cmedirl_jax"
"""What stands before a task's name, and a slash."""
_NO_LIMIT = 2**31 - 1


def make_one(*, task: str, render_mode: str | None = None) -> gymnasium.Env:
    """Make a registered task; `gymnasium.make` adds the time limit."""
    env = make(task)
    params = env.default_params.replace(max_episode_steps=_NO_LIMIT)
    return to_gymnasium(env, params, render_mode=render_mode)


def make_vector(
    *, task: str, num_envs: int, max_episode_steps: int, **kwargs: Any
) -> VectorEnv[np.ndarray, np.ndarray, np.ndarray]:
    """Make a registered task many times over; see `to_gymnasium_vector`."""
    env = make(task)
    params = env.default_params.replace(max_episode_steps=max_episode_steps)
    return to_gymnasium_vector(env, num_envs, params, **kwargs)


def register() -> None:
    """Register the tasks of which Gymnasium has its own."""
    for spec in (mountain_car.SPEC, pendulum.SPEC):
        name = f"{NAMESPACE}/{spec.id}"
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{__name__}:make_one",
                vector_entry_point=f"{__name__}:make_vector",
                max_episode_steps=spec.max_episode_steps,
                reward_threshold=spec.reward_threshold,
                kwargs={"task": spec.id},
            )


register()
