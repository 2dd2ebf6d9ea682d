"""Low-dimensional environments as finite Markov decision processes.

    mdp = discretise.make(env, (100, 100), (11,))
    policy = soft_value_iteration(mdp.dynamics, mdp.reward, discount=0.99, absorbing=mdp.absorbing)
    act = discretise.greedy(mdp, policy.action_values)

The states are the points of a grid over the observations, and one absorbing state in which every
terminated episode ends. Transitions are the environment's own, from each point (or from several
around it). Each successor is shared among the neighbouring points by multilinear weights.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, normalisation
from cmedirl_jax import grids as grids_lib
from cmedirl_jax.envs import Env, Step
from cmedirl_jax.envs.base import step_from
from cmedirl_jax.tabular import interpolation
from cmedirl_jax.tabular.dynamics import SparseDynamics
from cmedirl_jax.tabular.interpolation import Grid
from cmedirl_jax.types import Array, EnvSpec


class FiniteMDP(flax.struct.PyTreeNode):
    """An environment on grids: `S` states, the last one absorbing, and `A` actions.

    Attributes:
        dynamics: P(s'|s,a), sparse.
        reward: `[S, A]`, the environment's.
        absorbing: `[S]` bool.
        states: grid of the first `S - 1` states (static).
        actions: grid of the actions (static).
    """

    dynamics: SparseDynamics
    reward: jax.Array
    absorbing: jax.Array
    states: Grid = flax.struct.field(pytree_node=False)
    actions: Grid = flax.struct.field(pytree_node=False)


def make(
    env: Env,
    state_shape: Sequence[int],
    action_shape: Sequence[int],
    *,
    params: Any = None,
    subsamples: int = 1,
) -> FiniteMDP:
    """Discretise an environment whose steps do not draw random numbers.

    Args:
        env: the environment; it has to have a `state_at`.
        state_shape: points along each dimension of the observation.
        action_shape: points along each dimension of the action.
        params: default `env.default_params`.
        subsamples: transitions along each dimension that are averaged for a state, evenly spread
            over the cell around its point; 1 takes the point itself.

    Raises:
        ValueError: if the environment has no `state_at`, a bound beyond 1e6, or other dimensions,
            or the dynamics are above `checks.LARGEST_ARRAY`.
    """
    if env.state_at is None:
        raise ValueError(f"{env.spec.id} does not say which state an observation is of")
    checks.sizes(subsamples=subsamples)
    checks.array_size(
        "the dynamics [S, A, successors]",
        (*state_shape, *action_shape, *[2 * subsamples] * len(state_shape)),
        "take fewer states, actions or subsamples",
    )
    states, actions = grids(env.spec, state_shape, action_shape)
    within = (np.arange(subsamples) + 0.5) / subsamples - 0.5
    offsets = grids_lib.product(*[within] * len(states.shape))

    # Every pair of points. The barrier keeps the compiler from evaluating the rest as constants.
    of_pair = functools.partial(
        _successors, env, env.default_params if params is None else params, states, offsets
    )
    pairs = jax.lax.optimization_barrier(
        (jnp.asarray(interpolation.points(states)), jnp.asarray(interpolation.points(actions)))
    )
    over_actions = jax.vmap(of_pair, in_axes=(None, 0))
    index, weight, reward = jax.vmap(over_actions, in_axes=(0, None))(*pairs)

    # The absorbing state leads to itself.
    index = _append_row(index, states.size)
    weight = _append_row(weight, 1.0 / weight.shape[-1])
    return FiniteMDP(
        SparseDynamics(index, weight),
        _append_row(reward, 0.0),
        jnp.arange(states.size + 1) == states.size,
        states,
        actions,
    )


def _successors(
    env: Env,
    params: Any,
    states: Grid,
    offsets: np.ndarray,
    point: jax.Array,
    action: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Successors `[K]` of a grid point under an action, their probabilities, and the reward `[]`.

    Args:
        env: whose `state_at` is given.
        params: its parameters.
        states: grid of the observations.
        offsets: `[M, O]`, where transitions begin around a point, in units of the grid's spacing.
        point: `[O]`.
        action: `[A]`.
    """
    around = point[None] + offsets.astype(np.float32) * states.spacing.astype(np.float32)
    answer = jax.vmap(functools.partial(_step_from, env, params), in_axes=(0, None))(around, action)
    index, weight = interpolation.interpolate(states, answer.observation)
    index = jnp.where(answer.terminated[:, None], states.size, index)
    return index.ravel(), weight.ravel() / len(offsets), jnp.mean(answer.reward)


def _step_from(env: Env, params: Any, observation: jax.Array, action: jax.Array) -> Step:
    inside = jnp.clip(observation, env.spec.observation_low, env.spec.observation_high)
    return step_from(env, params, inside, action)


def _append_row(leaf: jax.Array, value: float) -> jax.Array:
    return jnp.concatenate([leaf, jnp.full_like(leaf[:1], value)])


def look_up(mdp: FiniteMDP, table: Array, observation: Array) -> jax.Array:
    """Interpolate a table of the states, `[S, ...]`, at observations `[..., O]`."""
    index, weight = interpolation.interpolate(mdp.states, observation)
    rows = jnp.asarray(table)[index]
    return jnp.sum(
        rows * weight.reshape(weight.shape + (1,) * (table.ndim - 1)), axis=weight.ndim - 1
    )


def greedy(mdp: FiniteMDP, action_values: Array) -> Callable[[jax.Array], jax.Array]:
    """The policy that takes the best action of the grid: `[..., O]` -> `[..., A]`.

    Args:
        mdp: the grids.
        action_values: Q `[S, A]` (or any other preference).
    """
    actions = jnp.asarray(interpolation.points(mdp.actions))
    return lambda observation: actions[
        jnp.argmax(look_up(mdp, action_values, observation), axis=-1)
    ]


def sampled(mdp: FiniteMDP, env: Env) -> Env:
    """`env` whose actions are log-probabilities of the grid's actions.

    Each step draws an action of the grid with its key. `evaluation.rollout` can thus run a
    stochastic policy: `lambda o: look_up(mdp, policy.log_probabilities, o)`. The action dimension
    is the number of the grid's actions. A log-probability may be -inf.
    """
    actions = jnp.asarray(interpolation.points(mdp.actions))
    size = len(actions)
    spec = env.spec._replace(
        action_dim=size,
        action_low=np.full(size, np.finfo(np.float32).min),
        action_high=np.zeros(size, np.float32),
    )
    return env._replace(spec=spec, step=functools.partial(_step_drawn, env, actions))


def _step_drawn(
    env: Env, actions: jax.Array, key: jax.Array, state: Any, action: jax.Array, params: Any
) -> tuple[Any, Step]:
    draw_key, step_key = jax.random.split(key)
    drawn = actions[jax.random.categorical(draw_key, action)]
    return env.step(step_key, state, drawn, params)


def grids(
    spec: EnvSpec, state_shape: Sequence[int], action_shape: Sequence[int]
) -> tuple[Grid, Grid]:
    """Grids over the bounds of the observations and of the actions.

    Raises:
        ValueError: if a bound is infinite, or the shapes do not have the specification's sizes.
    """

    normalisation.by_bounds(spec)

    def over(low: np.ndarray, high: np.ndarray, shape: Sequence[int]) -> Grid:
        return Grid(tuple(map(float, low)), tuple(map(float, high)), tuple(shape))

    return (
        over(spec.observation_low, spec.observation_high, state_shape),
        over(spec.action_low, spec.action_high, action_shape),
    )
