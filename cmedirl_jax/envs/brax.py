"""Tasks of brax and MuJoCo Playground, and any that have their shape; neither is imported.

    env = envs.from_brax(brax.envs.get_environment("inverted_pendulum"))

Needed are `reset(key) -> state`, `step(state, action) -> state` and `action_size`, where a state
has `obs`, `reward`, `done` and a dictionary `info`. Actions lie in [-1, 1], observations have no
bounds. A `done` that brax's episode wrapper sets at its time limit is told apart by
`info["truncation"]`.
"""

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.envs.base import Env, Reset, Step, cast_like, fixed_starts, spec_of


class BraxState(flax.struct.PyTreeNode):
    """A state of brax, and the steps of the episode so far, `[]` int32."""

    brax: Any
    time: jax.Array


def from_brax(
    env: Any,
    *,
    id: str | None = None,
    max_episode_steps: int = 1_000,
    reward_threshold: float | None = None,
) -> Env:
    """Make a task of brax one of this library.

    Args:
        env: the task, of one episode at a time, without brax's wrappers that vmap and that reset.
        id: its name; default that of its class.
        max_episode_steps: steps after which an episode is truncated.
        reward_threshold: the mean return that counts as solved, if there is one.

    Raises:
        ValueError: if its observations are several arrays, or it resets by itself.
    """
    name = type(env).__name__ if id is None else id
    state = jax.eval_shape(env.reset, jax.random.key(0))
    if not hasattr(state.obs, "shape") or len(state.obs.shape) != 1:
        raise ValueError(f"{name}: its observations are {state.obs}, not one array of one axis")
    if "first_obs" in state.info:
        raise ValueError(f"{name}: it resets by itself; give it without its AutoResetWrapper")
    size, actions = state.obs.shape[0], int(env.action_size)
    unbounded, unit = np.full(size, np.inf, np.float32), np.ones(actions, np.float32)
    spec = spec_of(
        name, (-unbounded, unbounded), (-unit, unit), max_episode_steps, reward_threshold
    )
    reset = functools.partial(_reset, env, actions)
    return Env(
        spec, (), reset, functools.partial(_step, env, max_episode_steps), fixed_starts(reset)
    )


def _reset(env: Any, actions: int, key: jax.Array, params: Any) -> Reset:
    del params
    state = env.reset(key)
    after = jax.eval_shape(env.step, state, jnp.zeros(actions, jnp.float32))
    state = cast_like(state, after)
    return BraxState(state, jnp.zeros((), jnp.int32)), jnp.asarray(state.obs, jnp.float32)


def _step(
    env: Any, limit: int, key: jax.Array, state: BraxState, action: jax.Array, params: Any
) -> tuple[BraxState, Step]:
    del key, params
    after = env.step(state.brax, jnp.clip(action, -1.0, 1.0))
    time = state.time + 1
    truncated = jnp.asarray(after.info.get("truncation", 0.0) > 0, bool)
    step = Step(
        jnp.asarray(after.obs, jnp.float32),
        jnp.asarray(after.reward, jnp.float32),
        jnp.asarray(after.done > 0, bool) & ~truncated,
        truncated | (time >= limit),
    )
    return BraxState(cast_like(after, state.brax), time), step
