"""Transition probabilities of a finite Markov decision process, dense or sparse."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, ranges
from cmedirl_jax.types import Array, Numeric

# Rounding: how far probabilities may sum from 1. Starts are counted in float32, one by one.
_TOLERANCE = {"dynamics": 1e-4, "probability": 1e-4, "initial": 1e-2}


class SparseDynamics(NamedTuple):
    """Up to `K` successors of each state and action; a successor may be listed more than once.

    Attributes:
        next_state: `[S, A, K]` int32, the successors; any number beside a probability of 0.
        probability: `[S, A, K]`, their probabilities, with sum 1 over `K`.
    """

    next_state: Array
    probability: Array


Dynamics = Array | SparseDynamics
"""P(s' | s, a): dense `[S, A, S]`, or sparse."""


def precision(dynamics: Dynamics, *numbers: Array | Numeric) -> jnp.dtype:
    """The type that a problem is solved in: the widest of its dynamics and its other numbers.

    Under `jax_enable_x64` a program may give one in 32 bits and another in 64.
    """
    probability = dynamics.probability if isinstance(dynamics, SparseDynamics) else dynamics
    return jnp.result_type(probability, *numbers)


def expected_next(dynamics: Dynamics, values: jax.Array) -> jax.Array:
    """sum_s' P(s'|s,a) V(s'): `[S]` -> `[S, A]`."""
    if isinstance(dynamics, SparseDynamics):
        return jnp.sum(dynamics.probability * values[dynamics.next_state], axis=-1)
    return jnp.asarray(dynamics) @ values


def next_distribution(dynamics: Dynamics, visits: jax.Array) -> jax.Array:
    """sum_{s,a} mu(s,a) P(s'|s,a): `[S, A]` -> `[S]`, the transpose of `expected_next`."""
    if isinstance(dynamics, SparseDynamics):
        arriving = dynamics.probability * visits[..., None]
        return jnp.zeros(visits.shape[0], arriving.dtype).at[dynamics.next_state].add(arriving)
    # A product of a vector and a matrix, which XLA knows better than a sum over two axes.
    dynamics = jnp.asarray(dynamics)
    return visits.reshape(-1) @ dynamics.reshape(visits.size, -1)


def probability_of(
    dynamics: Dynamics, state: np.ndarray, action: np.ndarray, successor: np.ndarray
) -> np.ndarray:
    """sum_m P(successor[:, m] | state, action), `[N]`, on the host.

    Args:
        dynamics: P(s'|s,a).
        state: `[N]` int.
        action: `[N]` int.
        successor: `[N, M]` int, different numbers in a row.
    """
    if isinstance(dynamics, SparseDynamics):
        following, chance = (np.asarray(leaf)[state, action] for leaf in dynamics)
        return np.sum(chance * (following[..., None] == successor[:, None]).any(axis=-1), axis=1)
    return np.sum(np.asarray(dynamics)[state[:, None], action[:, None], successor], axis=1)


def check(dynamics: Dynamics, state_actions: tuple[int, ...], **of_states: Array | None) -> None:
    """Check the dynamics of a decision process, and arrays that have an entry for each state.

    Args:
        dynamics: P(s'|s,a). The rows of absorbing states need not sum to 1.
        state_actions: (S, A), the reward's shape.
        of_states: arrays `[S]` by name; `absorbing` has to be bool, `initial` a distribution, the
            others finite floats.

    Raises:
        ValueError: for wrong shapes, with those expected; for known values out of range.
        TypeError: for wrong dtypes.
    """
    if isinstance(dynamics, SparseDynamics):
        shapes = (jnp.shape(dynamics.next_state), jnp.shape(dynamics.probability))
        fits = shapes[0] == shapes[1] and len(shapes[0]) == 3 and shapes[0][:2] == state_actions
    else:
        shapes = jnp.shape(dynamics)
        fits = shapes == (*state_actions, *state_actions[:1])
    if len(state_actions) != 2 or not fits:
        raise ValueError(
            f"expected a reward [S, A] and dynamics [S, A, S] or two arrays [S, A, K], "
            f"got {state_actions} and {shapes}"
        )
    for name, array in of_states.items():
        if array is not None:
            checks.shape(name, array, state_actions[:1])
            checks.kind(name, array, jnp.bool_ if name == "absorbing" else jnp.floating)
    _check_probabilities(dynamics, of_states.get("absorbing"))
    if (guess := of_states.get("guess")) is not None:
        checks.within(ranges.FINITE, guess=guess)
    if (initial := of_states.get("initial")) is not None:
        _check_distributions("initial", initial)


def _check_probabilities(dynamics: Dynamics, absorbing: Array | None) -> None:
    if not isinstance(dynamics, SparseDynamics):
        checks.kind("dynamics", dynamics, jnp.floating)
        _check_distributions("dynamics", dynamics, absorbing)
        return
    successor, probability = dynamics
    checks.kind("next_state", successor, jnp.integer)
    checks.kind("probability", probability, jnp.floating)
    _check_distributions("probability", probability, absorbing)
    if ranges.known(successor) and ranges.known(probability):
        index = np.where(np.asarray(probability) > 0, successor, 0)
        checks.indices(len(index), next_state=index)


def _check_distributions(name: str, array: Array, absorbing: Array | None = None) -> None:
    """Check that probabilities lie in [0, 1] and sum to 1 along the last axis, where known."""
    tolerance = _TOLERANCE[name]
    interval = ranges.SHARE._replace(low=-tolerance, high=1.0 + tolerance)
    checks.within(interval, **{name: array})
    if ranges.known(array) and ranges.known(absorbing):
        total = np.sum(np.asarray(array), axis=-1)
        if absorbing is not None:
            total = np.where(np.asarray(absorbing)[:, None], 1.0, total)
        interval = interval._replace(low=1.0 - tolerance, words="1")
        checks.within(interval, **{f"the sum of {name} over its last axis": total})


def check_reward(reward: Array) -> None:
    """Check that a reward holds floats, and no NaN.

    Raises:
        ValueError: if a known entry is NaN or inf; -inf forbids an action.
        TypeError: if it is not of floats.
    """
    checks.kind("reward", reward, jnp.floating)
    checks.within(ranges.FINITE._replace(low=-np.inf, words="finite or -inf"), reward=reward)


def check_control(discount: Numeric, horizon: int | None, temperature: Numeric = 1.0) -> None:
    """Check the numbers of a control problem.

    Raises:
        ValueError: if the horizon is below 1; if the discount, where it is known, is not between 0
            and 1 (below 1 without a horizon), or the temperature not positive and finite.
        TypeError: if the horizon is not an integer.
    """
    if horizon is None:
        checks.within(ranges.BELOW_ONE, **{"discount without a horizon": discount})
    else:
        checks.sizes(horizon=horizon)
        checks.shares(discount=discount)
    checks.positive(temperature=temperature)
