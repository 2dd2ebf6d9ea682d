"""The environment interface: pure functions, after gymnax, and their check."""

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
        truncated: `[]` bool, the time limit was reached (values still bootstrap). Both may be True.
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
        spec: the sizes and bounds. Static.
        default_params: physics and limits, as a pytree of traced leaves.
        reset: see `ResetFn`.
        step: see `StepFn`.
        starts: `(count, params) -> (states [count], observations [count, O])`, fixed start states
            for evaluation, evenly spread over the start distribution.
        state_at: `(observation [O], params) -> state`, the state with that observation, at step 0
            of an episode; None if an observation does not determine the state.
    """

    spec: EnvSpec
    default_params: Any
    reset: ResetFn
    step: StepFn
    starts: Callable[[int, Any], tuple[Any, jax.Array]]
    state_at: Callable[[jax.Array, Any], Any] | None = None


def check(env: Env, params: Any = None) -> None:
    """Check an environment's specification, and by tracing that its functions keep to it.

    Args:
        env: the environment.
        params: its parameters, default `env.default_params`.

    Raises:
        ValueError: naming what has a wrong shape or structure.
        TypeError: naming what has a wrong dtype.
    """
    spec = env.spec
    checks.env_spec(spec)
    params = env.default_params if params is None else params
    key = jax.eval_shape(lambda: jax.random.key(0))
    action = jax.ShapeDtypeStruct((spec.action_dim,), jnp.float32)

    # An episode's first state and a step from it.
    state, observation = jax.eval_shape(lambda key: env.reset(key, params), key)
    _check_observation(spec, "reset", observation)
    after, step = jax.eval_shape(
        lambda key, state, action: env.step(key, state, action, params), key, state, action
    )
    _check_state(spec, "state after a step", after, state)
    _check_observation(spec, "step", step.observation)
    kinds = {"reward": jnp.floating, "terminated": jnp.bool_, "truncated": jnp.bool_}
    for name, kind in kinds.items():
        checks.shape(f"{spec.id}: {name}", getattr(step, name), ())
        checks.kind(f"{spec.id}: {name}", getattr(step, name), kind)

    # The fixed starts, and states of given observations.
    count = 2
    states, observations = jax.eval_shape(lambda: env.starts(count, params))
    _check_observation(spec, "starts", observations, count)
    first = jax.eval_shape(lambda states: jax.tree.map(lambda leaf: leaf[0], states), states)
    _check_state(spec, "a state of starts", first, state)
    if env.state_at is not None:
        state_at = env.state_at
        of_observation = jax.eval_shape(lambda seen: state_at(seen, params), observation)
        _check_state(spec, "state_at", of_observation, state)


def _check_state(spec: EnvSpec, name: str, state: Any, expected: Any) -> None:
    leaves, wanted = (
        [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)] for tree in (state, expected)
    )
    if leaves != wanted or jax.tree.structure(state) != jax.tree.structure(expected):
        raise ValueError(f"{spec.id}: {name} is not of reset's kind: {state}, not {expected}")


def _check_observation(spec: EnvSpec, name: str, observation: Any, *leading: int) -> None:
    name = f"{spec.id}: observation of {name}"
    checks.shape(name, observation, (*leading, spec.observation_dim))
    checks.kind(name, observation, jnp.floating)
