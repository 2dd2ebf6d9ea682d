"""A task in JAX that pays a reward of one's own; `wrappers` does the same for Gymnasium's tasks.

paying = envs.with_reward(env, lambda params, observation, action: r_d(observation, action))
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax.envs.base import Env, Step

Reward = Callable[[Any, jax.Array, jax.Array], jax.Array]
"""`(reward parameters, observation [O], action [A]) -> []`."""
Mode = Literal["replace", "add"]


class PayingParams(NamedTuple):
    """Parameters of a task that pays another reward.

    Attributes:
        env: the task's own.
        reward: the reward's.
    """

    env: Any
    reward: Any


class PayingState(NamedTuple):
    """A state of a task that pays another reward.

    Attributes:
        env: the task's state.
        observation: `[O]`, what was observed of it.
    """

    env: Any
    observation: jax.Array


def with_reward(
    env: Env, reward: Reward, reward_params: Any = (), *, mode: Mode = "replace"
) -> Env:
    """Pay a learned reward in place of the task's own, or on top of it (Eq. 10).

    Args:
        env: the task.
        reward: r_D; it gets actions within their bounds.
        reward_params: what it is called with first: in the task's `default_params`, so that one
            program may run many rewards.
        mode: "replace": r_D(s, a); "add": r_e + r_D(s, a).

    Raises:
        ValueError: for another mode.
    """
    if mode not in ("replace", "add"):
        raise ValueError(f"mode: {mode!r} is none of replace, add")
    return Env(
        spec=env.spec,
        default_params=PayingParams(env.default_params, reward_params),
        reset=functools.partial(_reset, env),
        step=functools.partial(_step, env, reward, mode),
        starts=functools.partial(_starts, env),
        state_at=None if env.state_at is None else functools.partial(_state_at, env),
    )


def _reset(env: Env, key: jax.Array, params: PayingParams) -> tuple[PayingState, jax.Array]:
    state, observation = env.reset(key, params.env)
    return PayingState(state, observation), observation


def _starts(env: Env, count: int, params: PayingParams) -> tuple[PayingState, jax.Array]:
    states, observations = env.starts(count, params.env)
    return PayingState(states, observations), observations


def _state_at(env: Env, observation: jax.Array, params: PayingParams) -> PayingState:
    assert env.state_at is not None
    return PayingState(env.state_at(observation, params.env), jnp.asarray(observation))


def _step(
    env: Env,
    reward: Reward,
    mode: Mode,
    key: jax.Array,
    state: PayingState,
    action: jax.Array,
    params: PayingParams,
) -> tuple[PayingState, Step]:
    within = jnp.clip(action, env.spec.action_low, env.spec.action_high)
    paid = reward(params.reward, state.observation, within)
    after, step = env.step(key, state.env, action, params.env)
    if mode == "add":
        paid += step.reward
    return PayingState(after, step.observation), step._replace(reward=paid)
