"""The environment interface: pure functions, after gymnax."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.types import EnvSpec


class Step(NamedTuple):
    """What one step returns beside the new state.

    Attributes:
        observation: `[O]` float32, of the new state; never that of a reset.
        reward: `[]` float32.
        terminated: `[]` bool, the task ended (no bootstrapping).
        truncated: `[]` bool, the time limit was reached (values still bootstrap). Both may be True.
    """

    observation: Any
    reward: Any
    terminated: Any
    truncated: Any


class ResetFn(Protocol):
    """Start an episode."""

    def __call__(self, key: jax.Array, params: Any) -> tuple[Any, jax.Array]:
        """Return the first state and its observation `[O]`."""
        ...


class StepFn(Protocol):
    """Advance by one action. No auto-reset."""

    def __call__(
        self, key: jax.Array, state: Any, action: jax.Array, params: Any
    ) -> tuple[Any, Step]:
        """Return the new state and its `Step`, for `action` `[A]`."""
        ...


Bounds = tuple[np.ndarray, np.ndarray]
"""Lower and upper bounds, `[n]` float32."""


def spec_of(
    id: str,
    observation: Bounds,
    action: Bounds,
    max_episode_steps: int,
    reward_threshold: float | None,
) -> EnvSpec:
    """The specification of a task with these bounds; `EnvSpec` describes the rest."""
    return EnvSpec(
        id=id,
        observation_dim=len(observation[0]),
        action_dim=len(action[0]),
        observation_low=observation[0],
        observation_high=observation[1],
        action_low=action[0],
        action_high=action[1],
        max_episode_steps=max_episode_steps,
        reward_threshold=reward_threshold,
    )


Reset = tuple[Any, jax.Array]
"""A first state, and its observation `[O]`."""


def fixed_starts(reset: ResetFn) -> Callable[[int, Any], Reset]:
    """Evaluation starts of fixed keys: `(count, params) -> (states, observations)`."""

    def starts(count: int, params: Any) -> Reset:
        keys = jax.random.split(jax.random.key(0), count)
        return jax.vmap(reset, in_axes=(0, None))(keys, params)

    return starts


def cast_like(state: Any, like: Any) -> Any:
    """A state whose leaves have the types of another's, where `reset` and `step` differ in them."""

    def cast(leaf: Any, wanted: Any) -> jax.Array:
        leaf = jnp.asarray(leaf)
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return leaf
        return jax.lax.convert_element_type(leaf, wanted.dtype)

    return jax.tree.map(cast, state, like)


class Env(NamedTuple):
    """An environment: `env.step(key, state, action, params)`, vmappable over every argument.

    Attributes:
        spec: the sizes and bounds. Static.
        default_params: physics and limits, as a pytree of traced leaves.
        reset: see `ResetFn`.
        step: see `StepFn`.
        starts: `(count, params) -> (states [count], observations [count, O])`, fixed start states
            for evaluation, which weigh as `reset` draws them.
        state_at: `(observation [O], params) -> state`, the state with that observation, at step 0
            of an episode; None if an observation does not determine the state.
        gymnasium_state: `(state) -> array`, on the host: what the attribute `state` of Gymnasium's
            environment of the same name holds there; None if Gymnasium has no such environment.
    """

    spec: EnvSpec
    default_params: Any
    reset: ResetFn
    step: StepFn
    starts: Callable[[int, Any], tuple[Any, jax.Array]]
    state_at: Callable[[jax.Array, Any], Any] | None = None
    gymnasium_state: Callable[[Any], np.ndarray] | None = None


def step_from(env: Env, params: Any, observation: jax.Array, action: jax.Array) -> Step:
    """What a task that draws nothing answers to an action `[A]` at an observation `[O]`.

    Args:
        env: whose `state_at` is given.
        params: its parameters.
        observation: which determines the state.
        action: the action.
    """
    assert env.state_at is not None
    return env.step(jax.random.key(0), env.state_at(observation, params), action, params)[1]
