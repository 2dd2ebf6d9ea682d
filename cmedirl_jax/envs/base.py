"""The environment interface: two pure functions, in the manner of gymnax."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax

from cmedirl_jax.types import EnvSpec


class Step(NamedTuple):
    """What one step returns beside the new state.

    Attributes:
        observation: `[O]` float32, of the new state; never that of a reset.
        reward: `[]` float32.
        terminated: `[]` bool, the task ended (no bootstrapping).
        truncated: `[]` bool, the time limit was reached (bootstrapping goes on). Both may be set.
    """

    observation: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


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


class Env(NamedTuple):
    """An environment: `env.step(key, state, action, params)`, vmappable over every argument.

    Attributes:
        spec: static facts.
        default_params: physics and limits as a pytree of traced leaves.
        reset: see `ResetFn`.
        step: see `StepFn`.
        starts: `(count, params) -> (states [count], observations [count, O])`, fixed start states
            evenly spread over the start distribution, for evaluation.
        state_at: `(observation [O], params) -> state` at the start of its clock, where an
            observation says all about the state; else None.
    """

    spec: EnvSpec
    default_params: Any
    reset: ResetFn
    step: StepFn
    starts: Callable[[int, Any], tuple[Any, jax.Array]]
    state_at: Callable[[jax.Array, Any], Any] | None = None
