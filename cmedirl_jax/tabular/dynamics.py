"""Transition probabilities of a finite Markov decision process, dense or sparse."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import checks
from cmedirl_jax.types import Array, Numeric


class SparseDynamics(NamedTuple):
    """Up to `K` successors of each state and action; a successor may be listed more than once.

    Attributes:
        next_state: `[S, A, K]` int32, the successors.
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
    return jnp.einsum("sa,sat->t", visits, dynamics)


def check(dynamics: Dynamics, state_actions: tuple[int, ...], **of_states: Array | None) -> None:
    """Check the dynamics of a decision process, and arrays that have an entry for each state.

    Args:
        dynamics: P(s'|s,a).
        state_actions: (S, A), the reward's shape.
        of_states: arrays `[S]` by name; `absorbing` has to be bool, the others floats.

    Raises:
        ValueError: for wrong shapes, with those expected.
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
    if isinstance(dynamics, SparseDynamics):
        checks.kind("next_state", dynamics.next_state, jnp.integer)
        checks.kind("probability", dynamics.probability, jnp.floating)
    else:
        checks.kind("dynamics", dynamics, jnp.floating)
    for name, array in of_states.items():
        if array is not None:
            checks.shape(name, array, state_actions[:1])
            checks.kind(name, array, jnp.bool_ if name == "absorbing" else jnp.floating)


def check_horizon(horizon: int | None) -> None:
    """Check that a horizon, if there is one, is positive.

    Raises:
        ValueError: if it is not.
    """
    if horizon is not None:
        checks.sizes(horizon=horizon)
