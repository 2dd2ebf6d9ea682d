"""Optimal control of a finite Markov decision process: the largest return of any policy."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import modes
from cmedirl_jax.tabular import dynamics as dynamics_lib
from cmedirl_jax.tabular import fixed_point
from cmedirl_jax.tabular.dynamics import Dynamics
from cmedirl_jax.tabular.fixed_point import Stop
from cmedirl_jax.types import Array, Numeric


class OptimalPolicy(NamedTuple):
    """Optimal values.

    Attributes:
        values: `[T, S]`, V*_t(s) with T - t steps to go; `[S]` for an infinite horizon.
        action_values: `[S, A]`, Q* at the first step. Those of later steps would take `T` times the
            memory; `expected_next` of the values gives them.
        residual: `[]`, see `SoftPolicy`.
    """

    values: jax.Array
    action_values: jax.Array
    residual: jax.Array


def value_iteration(
    dynamics: Dynamics,
    reward: jax.Array,
    *,
    discount: Numeric,
    horizon: int | None = None,
    absorbing: Array | None = None,
    stop: Stop | None = None,
) -> OptimalPolicy:
    """V*(s) = max_a r(s, a) + gamma sum_s' P(s'|s,a) V*(s').

    The arguments are those of `soft_value_iteration`, without a temperature and a first guess.

    Raises:
        ValueError: if the shapes do not fit each other, the horizon is below 1, or a value that is
            not traced is out of range.
        TypeError: for wrong dtypes.
    """
    dynamics_lib.check(dynamics, jnp.shape(reward), absorbing=absorbing)
    dynamics_lib.check_reward(reward)
    dynamics_lib.check_control(discount, horizon)
    reward = jnp.asarray(reward, dynamics_lib.precision(dynamics, reward, discount))

    def action_values(values: jax.Array) -> jax.Array:
        return reward + discount * dynamics_lib.expected_next(dynamics, values)

    def back_up(values: jax.Array) -> jax.Array:
        best = jnp.max(action_values(values), axis=-1)
        return best if absorbing is None else jnp.where(absorbing, 0.0, best)

    last = modes.settle(back_up, jnp.zeros_like(reward[:, 0]))
    if horizon is None:
        values, residual = fixed_point.iterate(back_up, last, stop or Stop())
        return OptimalPolicy(values, action_values(values), residual)

    def body(values: jax.Array, _: None):
        return (values := back_up(values)), values

    _, values = jax.lax.scan(body, last, None, length=horizon, reverse=True)
    following = jnp.concatenate([values, last[None]])[1]
    return OptimalPolicy(values, action_values(following), jnp.zeros((), reward.dtype))
