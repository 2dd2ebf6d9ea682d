"""The environment interface: two pure functions, in the manner of gymnax."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from cmedirl_jax import checks
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


def check(env: Env, params: Any = None) -> None:
    """Check an environment's specification, and that its functions keep to it. Nothing is run.

    Args:
        env: the environment.
        params: its parameters, default `env.default_params`.

    Raises:
        ValueError: naming what has another shape, or another structure.
        TypeError: naming what has another dtype.
    """
    spec = env.spec
    checks.env_spec(spec)
    params = env.default_params if params is None else params
    key = jax.eval_shape(lambda: jax.random.key(0))
    action = jax.ShapeDtypeStruct((spec.action_dim,), jnp.float32)

    def same(name: str, found: Any, expected: Any) -> None:
        leaves = [[(x.shape, x.dtype) for x in jax.tree.leaves(tree)] for tree in (found, expected)]
        if leaves[0] != leaves[1] or jax.tree.structure(found) != jax.tree.structure(expected):
            raise ValueError(f"{spec.id}: {name} is not of reset's kind: {found}, not {expected}")

    def observations(name: str, found: Any, *leading: int) -> None:
        name = f"{spec.id}: observation of {name}"
        checks.shape(name, found, (*leading, spec.observation_dim))
        checks.kind(name, found, jnp.floating)

    state, observation = jax.eval_shape(lambda key: env.reset(key, params), key)
    observations("reset", observation)
    after, step = jax.eval_shape(
        lambda key, state, action: env.step(key, state, action, params), key, state, action
    )
    same("state after a step", after, state)
    observations("step", step.observation)
    for name, kind in (
        ("reward", jnp.floating),
        ("terminated", jnp.bool_),
        ("truncated", jnp.bool_),
    ):
        checks.shape(f"{spec.id}: {name}", getattr(step, name), ())
        checks.kind(f"{spec.id}: {name}", getattr(step, name), kind)
    count = 2
    states, start_observations = jax.eval_shape(lambda: env.starts(count, params))
    observations("starts", start_observations, count)
    first = jax.eval_shape(lambda states: jax.tree.map(lambda leaf: leaf[0], states), states)
    same("a state of starts", first, state)
    if env.state_at is not None:
        state_at = env.state_at
        of_observation = jax.eval_shape(lambda seen: state_at(seen, params), observation)
        same("state_at", of_observation, state)
