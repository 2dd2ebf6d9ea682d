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
from cmedirl_jax.envs.gymnasium_env import Drawing, to_gymnasium
from cmedirl_jax.envs.gymnasium_vector import to_gymnasium_vector
from cmedirl_jax.envs.registry import make

GYMNASIUM_NAMESPACE = "cmedirl_jax"
"""What stands before the slash and the name of a task of ours in Gymnasium's registry."""
_NO_LIMIT = 2**31 - 1


def make_one(*, task: str, render_mode: str | None = None) -> gymnasium.Env:
    """Make a registered task; `gymnasium.make` adds the time limit.

    Raises:
        ValueError: if there is no such task, or Gymnasium cannot draw it.
    """
    env = make(task)
    params = env.default_params.replace(max_episode_steps=_NO_LIMIT)
    return to_gymnasium(env, params, render_mode=render_mode)


# What `gymnasium.make` reads of a class.
make_one.metadata = Drawing.metadata  # type: ignore[attr-defined]


def make_vector(
    *, task: str, num_envs: int, max_episode_steps: int | None, **kwargs: Any
) -> VectorEnv[np.ndarray, np.ndarray, np.ndarray]:
    """Make a registered task many times over, for None or -1 without a limit.

    See `to_gymnasium_vector`.

    Raises:
        ValueError: if there is no such task, and as `to_gymnasium_vector`.
        TypeError: as `to_gymnasium_vector`.
    """
    env = make(task)
    limit = _NO_LIMIT if max_episode_steps in (None, -1) else max_episode_steps
    params = env.default_params.replace(max_episode_steps=limit)
    return to_gymnasium_vector(env, num_envs, params, **kwargs)


def register() -> None:
    """Register the tasks of which Gymnasium has its own."""
    for spec in (mountain_car.SPEC, pendulum.SPEC):
        name = f"{GYMNASIUM_NAMESPACE}/{spec.id}"
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
