"""Whether an environment keeps to its specification."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, modes, rounding
from cmedirl_jax.envs.base import Env, Step
from cmedirl_jax.types import EnvSpec

EPISODES = 4
"""Episodes that `check` plays."""


def check(env: Env, params: Any = None, *, steps: int | None = None) -> None:
    """Check an environment against its specification: by tracing, then by playing a few episodes.

    One of them takes the least actions throughout, one the greatest, the others random ones.

    Args:
        env: the environment.
        params: its parameters, default `env.default_params`.
        steps: of each episode to play, default `env.spec.max_episode_steps`. With 0 the functions
            are only traced, and `params` may be traced too.

    Raises:
        ValueError: if the specification contradicts itself or `steps` is negative; naming what has
            a wrong shape or structure. In play, saying what the task did and what its specification
            says: observations out of bounds, values that are not finite, an episode that goes on
            after `max_episode_steps`, or another step from `state_at(observation)` than from the
            state that was observed.
        TypeError: naming what has a wrong type; for a task on the host.
    """
    if not isinstance(env, Env):
        raise TypeError(
            f"{env.spec.id} is no task in JAX: from_gymnasium has tried it, and "
            "gymnasium.utils.env_checker.check_env says more"
        )
    params = env.default_params if params is None else params
    steps = env.spec.max_episode_steps if steps is None else steps
    checks.counts(steps=steps)
    _check_traced(env, params)
    if steps:
        _check_played(env, params, steps)


def _check_traced(env: Env, params: Any) -> None:
    spec = env.spec
    checks.env_spec(spec)
    key = jax.eval_shape(lambda: jax.random.key(0))
    action = jax.ShapeDtypeStruct((spec.action_dim,), jnp.float32)

    # An episode's first state and a step from it.
    state, observation = jax.eval_shape(lambda key: env.reset(key, params), key)
    dtype = jnp.result_type(observation)
    _check_observation(spec, "reset", observation, dtype)
    after, step = jax.eval_shape(
        lambda key, state, action: env.step(key, state, action, params), key, state, action
    )
    _check_state(spec, "state after a step", after, state)
    _check_observation(spec, "step", step.observation, dtype)
    kinds = {"reward": jnp.floating, "terminated": jnp.bool_, "truncated": jnp.bool_}
    for name, kind in kinds.items():
        checks.shape(f"{spec.id}: {name}", getattr(step, name), ())
        checks.kind(f"{spec.id}: {name}", getattr(step, name), kind)

    # The fixed starts, and states of given observations.
    count = 2
    states, observations = jax.eval_shape(lambda: env.starts(count, params))
    _check_observation(spec, "starts", observations, dtype, count)
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


def _check_observation(
    spec: EnvSpec, name: str, observation: Any, of_reset: Any, *leading: int
) -> None:
    name = f"{spec.id}: observation of {name}"
    checks.shape(name, observation, (*leading, spec.observation_dim))
    checks.kind(name, observation, jnp.floating)
    if jnp.result_type(observation) != of_reset:
        raise TypeError(f"{name}: is {jnp.result_type(observation)}, that of reset {of_reset}")


class _Played(NamedTuple):
    """Episodes side by side, `E` of them.

    Attributes:
        first: `[E, O]`, the observations of `reset`.
        running: `[T, E]` bool, the episode had not ended before this step.
        step: leaves `[T, E, ...]`.
        from_observation: the same step from `state_at` of the observation before it, or None.
    """

    first: np.ndarray
    running: np.ndarray
    step: Step
    from_observation: Step | None


def _play(env: Env, params: Any, steps: int) -> _Played:
    spec, state_at = env.spec, env.state_at
    reset_key, action_key, step_key = jax.random.split(jax.random.key(0), 3)
    first = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(reset_key, EPISODES), params)
    shape = (steps, EPISODES, spec.action_dim)
    share = jax.random.uniform(action_key, shape, jnp.float32).at[:, 0].set(0.0).at[:, 1].set(1.0)
    share, low, high = modes.align(share, spec.action_low, spec.action_high)
    actions = low + share * (high - low)
    step_all = jax.vmap(env.step, in_axes=(0, 0, 0, None))

    def advance(carry: Any, draws: Any) -> Any:
        (states, observations, running), (keys, actions) = carry, draws
        again = None
        if state_at is not None:
            states_at = jax.vmap(state_at, in_axes=(0, None))(observations, params)
            again = step_all(keys, states_at, actions, params)[1]
        states, step = step_all(keys, states, actions, params)
        still = running & ~(step.terminated | step.truncated)
        return (states, step.observation, still), (running, step, again)

    draws = jax.random.split(step_key, shape[:2]), actions
    _, columns = jax.lax.scan(advance, (*first, jnp.ones(EPISODES, bool)), draws)
    return _Played(*jax.tree.map(np.asarray, (first[1], *columns)))


def _check_played(env: Env, params: Any, steps: int) -> None:
    spec = env.spec
    first, running, step, from_observation = _play(env, params, steps)
    starts = np.asarray(env.starts(EPISODES, params)[1])
    _check_bounds(spec, "starts", starts[None])
    _check_bounds(spec, "reset", first[None])
    _check_bounds(spec, "step", np.where(running[..., None], step.observation, first))
    wrong = running & ~np.isfinite(step.reward)
    if wrong.any():
        time, episode = np.argwhere(wrong)[0]
        raise ValueError(f"{spec.id}: reward is {step.reward[time, episode]} at step {time}")
    limit = spec.max_episode_steps
    if steps >= limit:
        at_limit = jax.tree.map(lambda leaf: leaf[limit - 1], step)
        if (running[limit - 1] & ~(at_limit.terminated | at_limit.truncated)).any():
            raise ValueError(
                f"{spec.id}: an episode goes on after {limit} steps, its specification's "
                "max_episode_steps"
            )
    if from_observation is not None:
        _check_state_at(spec, running, step, from_observation)


def _check_bounds(spec: EnvSpec, name: str, observations: np.ndarray) -> None:
    """Check observations `[T, E, O]`."""
    low, high = spec.observation_low, spec.observation_high
    outside = rounding.outside(observations, low, high)
    if outside.any():
        time, episode, index = np.argwhere(outside)[0]
        found = observations[time, episode, index]
        raise ValueError(
            f"{spec.id}: observation[{index}] of {name} is {found:.7g} at step {time}, its "
            f"specification keeps it in {low[index]:.7g} to {high[index]:.7g}"
        )


def _check_state_at(spec: EnvSpec, running: np.ndarray, step: Step, again: Step) -> None:
    for name in ("observation", "reward", "terminated"):
        # The running episodes' steps, one after the other.
        expected, found = (
            getattr(made, name)[running].astype(np.float64).reshape(running.sum(), -1)
            for made in (step, again)
        )
        wrong = ~(np.abs(found - expected) <= rounding.tolerance(expected))
        if wrong.any():
            place = tuple(np.argwhere(wrong)[0])
            raise ValueError(
                f"{spec.id}: {name} of step {np.argwhere(running)[place[0]][0]} is "
                f"{expected[place]:.7g}, from state_at of the observation before {found[place]:.7g}"
            )
