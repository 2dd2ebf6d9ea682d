"""Tasks of gymnax, and any that have its shape, as tasks of this library; gymnax is not imported.

    env = envs.from_gymnax(*gymnax.make("Pendulum-v1"))

Needed are `reset_env`, `step_env`, `is_terminal`, `observation_space`, `action_space` and a state
with a `time`. gymnax says with one flag that an episode is over; here the time limit is told apart,
by asking `is_terminal` of the same state at time 0.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.envs.base import Bounds, Env, Reset, Step, cast_like, fixed_starts, spec_of
from cmedirl_jax.types import EnvSpec


def from_gymnax(
    env: Any, params: Any = None, *, id: str | None = None, reward_threshold: float | None = None
) -> Env:
    """Make a task of gymnax one of this library.

    Args:
        env: the task, with continuous observations and actions `[n]`.
        params: its parameters; they become `default_params`. Default `env.default_params`.
        id: its name; default `env.name`.
        reward_threshold: the mean return that counts as solved, if there is one.

    Raises:
        ValueError: if a space is discrete, or not one axis.
    """
    params = env.default_params if params is None else params
    name = env.name if id is None else id
    spec = spec_of(
        name,
        _bounds(name, "observations", env.observation_space(params)),
        _bounds(name, "actions", env.action_space(params)),
        int(params.max_steps_in_episode),
        reward_threshold,
    )
    step = functools.partial(_step, env)
    reset = functools.partial(_reset, env, spec)
    return Env(spec, params, reset, step, fixed_starts(reset))


def _bounds(name: str, what: str, space: Any) -> Bounds:
    if not hasattr(space, "low"):
        raise ValueError(f"{name}: its {what} are {type(space).__name__}, not continuous")
    if len(space.shape) != 1:
        raise ValueError(f"{name}: its {what} have shape {space.shape}, not one axis")
    low, high = (
        np.broadcast_to(np.asarray(x, np.float32), space.shape) for x in (space.low, space.high)
    )
    return low.copy(), high.copy()


def _reset(env: Any, spec: EnvSpec, key: jax.Array, params: Any) -> Reset:
    observation, state = env.reset_env(key, params)
    action = jnp.zeros(spec.action_dim, jnp.float32)
    after = jax.eval_shape(lambda: env.step_env(key, state, action, params)[1])
    return cast_like(state, after), jnp.asarray(observation, jnp.float32)


def _step(env: Any, key: jax.Array, state: Any, action: jax.Array, params: Any) -> tuple[Any, Step]:
    observation, after, reward, done, _ = env.step_env(key, state, action, params)
    # At the time limit the end counts as the task's own if it would be one at time 0 too.
    truncated = jnp.asarray(after.time >= params.max_steps_in_episode, bool)
    untimed = after.replace(time=jnp.zeros_like(after.time))
    at_any_time = jnp.asarray(env.is_terminal(untimed, params), bool)
    step = Step(
        jnp.asarray(observation, jnp.float32),
        jnp.asarray(reward, jnp.float32).reshape(()),
        jnp.asarray(done, bool) & (at_any_time | ~truncated),
        truncated,
    )
    return cast_like(after, state), step
