"""Maximum-entropy control of a finite Markov decision process, with a model (Eqs. 7 and 8).

    policy = soft_value_iteration(dynamics, reward, discount=0.99)
    visits = expected_visitation(dynamics, policy, initial, discount=0.99)

The value is soft: V(s) = alpha log sum_a exp(Q(s, a) / alpha). With alpha = 1, deterministic
dynamics and the demonstrations' starts, mu_D - E[mu] is exactly the derivative of the
demonstrations' (discounted) causal log-likelihood by the reward. With hard value iteration it is
not.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import modes
from cmedirl_jax.tabular import dynamics as dynamics_lib
from cmedirl_jax.tabular import fixed_point
from cmedirl_jax.tabular.dynamics import Dynamics
from cmedirl_jax.tabular.fixed_point import Stop
from cmedirl_jax.types import Array, Numeric


class SoftPolicy(NamedTuple):
    """The soft-optimal policy. For an infinite horizon there is no axis `T`.

    Attributes:
        log_probabilities: `[T, S, A]`, log pi_t(a|s) = (Q_t(s, a) - V_t(s)) / alpha.
        action_values: `[T, S, A]`, Q_t(s, a) = r(s, a) + gamma sum_s' P(s'|s,a) V_{t+1}(s').
        values: `[T, S]`, V_t(s) = alpha log sum_a exp(Q_t(s, a) / alpha); 0 where absorbing.
        residual: `[]`, relative change at the last iteration; 0 for a finite horizon. It is above
            the tolerance only if the limit on iterations was reached.
    """

    log_probabilities: jax.Array
    action_values: jax.Array
    values: jax.Array
    residual: jax.Array


def soft_value_iteration(
    dynamics: Dynamics,
    reward: jax.Array,
    *,
    discount: Numeric,
    horizon: int | None = None,
    temperature: Numeric = 1.0,
    absorbing: Array | None = None,
    stop: Stop | None = None,
    guess: jax.Array | None = None,
) -> SoftPolicy:
    """Solve for the soft-optimal policy. It is differentiable by the reward.

    Args:
        dynamics: P(s'|s,a).
        reward: `[S, A]`.
        discount: gamma, per step, between 0 and 1; below 1 for an infinite horizon.
        horizon: steps T of an episode, with V_T = 0; None: infinite, by a fixed point.
        temperature: alpha, above 0.
        absorbing: `[S]` bool, the states in which an episode is over: there is no reward, no action
            and no entropy.
        stop: when the fixed point's iteration ends.
        guess: `[S]`, values at which that iteration begins; default zeros.

    Raises:
        ValueError: if the shapes do not fit each other, the horizon is below 1, or a value that is
            not traced is out of range (probabilities that do not sum to 1, a NaN).
        TypeError: for wrong dtypes.
    """
    dynamics_lib.check(dynamics, jnp.shape(reward), absorbing=absorbing, guess=guess)
    dynamics_lib.check_reward(reward)
    dynamics_lib.check_control(discount, horizon, temperature)
    precision = dynamics_lib.precision(dynamics, reward, discount, temperature)
    reward = jnp.asarray(reward, precision)

    def back_up(values: jax.Array) -> tuple[jax.Array, jax.Array]:
        q = reward + discount * dynamics_lib.expected_next(dynamics, values)
        v = temperature * jax.nn.logsumexp(q / temperature, axis=-1)
        return v if absorbing is None else jnp.where(absorbing, 0.0, v), q

    residual = jnp.zeros((), reward.dtype)
    if horizon is None:
        guess = jnp.zeros_like(reward[:, 0]) if guess is None else jnp.asarray(guess, precision)
        values, residual = fixed_point.solve(lambda v: back_up(v)[0], guess, stop or Stop())
        values, q = back_up(values)
    else:

        def body(values: jax.Array, _: None):
            values, q = back_up(values)
            return values, (values, q)

        last = modes.settle(lambda values: back_up(values)[0], jnp.zeros_like(reward[:, 0]))
        _, (values, q) = jax.lax.scan(body, last, None, length=horizon, reverse=True)
    return SoftPolicy(jax.nn.log_softmax(q / temperature, axis=-1), q, values, residual)


def expected_visitation(
    dynamics: Dynamics,
    policy: SoftPolicy,
    initial: jax.Array,
    *,
    discount: Numeric,
    horizon: int | None = None,
    absorbing: Array | None = None,
    stop: Stop | None = None,
    guess: jax.Array | None = None,
) -> jax.Array:
    """`E[mu](s, a)` = sum_t gamma^t D_t(s) pi_t(a|s), `[S, A]` (Eq. 7, by dynamic programming).

    D_{t+1}(s') = sum_{s,a} D_t(s) pi_t(a|s) P(s'|s,a). Absorbing states count no visits.

    Args:
        dynamics: P(s'|s,a).
        policy: what `soft_value_iteration` gave for the same horizon.
        initial: `[S]`, the distribution of the first state.
        discount: gamma, per step.
        horizon: steps T of an episode; None: infinite, by a fixed point.
        absorbing: `[S]` bool, the states in which an episode is over.
        stop: when the fixed point's iteration ends.
        guess: `[S]`, discounted visits at which that iteration begins; default `initial`.

    Raises:
        ValueError: if the policy is for another horizon, the shapes do not fit each other, or a
            value that is not traced is out of range.
        TypeError: for wrong dtypes.
    """
    dynamics_lib.check_control(discount, horizon)
    steps = () if horizon is None else (horizon,)
    size = policy.log_probabilities.shape[-2:]
    if policy.log_probabilities.shape != (*steps, *size):
        raise ValueError(
            f"a policy of horizon {horizon} has log_probabilities {(*steps, 'S', 'A')}, "
            f"got {policy.log_probabilities.shape}"
        )
    dynamics_lib.check(dynamics, size, initial=initial, absorbing=absorbing, guess=guess)
    probabilities = jnp.exp(policy.log_probabilities)
    precision = dynamics_lib.precision(dynamics, initial, probabilities, discount)
    initial = jnp.asarray(initial, precision)
    if absorbing is not None:
        probabilities = jnp.where(jnp.asarray(absorbing)[:, None], 0.0, probabilities)

    # Infinite horizon: the discounted visits of each state are a fixed point.
    if horizon is None:
        extend = functools.partial(_extend, dynamics, probabilities, initial, discount)
        guess = initial if guess is None else jnp.asarray(guess, precision)
        visits, _ = fixed_point.solve(extend, guess, stop or Stop())
        return visits[:, None] * probabilities

    # Finite horizon: forward in time, adding up.
    move = functools.partial(_move, dynamics, discount)
    carry = (initial, jnp.ones_like(initial[0]), jnp.zeros_like(probabilities[0], precision))
    carry = modes.settle(lambda carry, step: move(carry, step)[0], carry, probabilities[0])
    (_, _, total), _ = jax.lax.scan(move, carry, probabilities)
    return total


def _extend(
    dynamics: Dynamics,
    probabilities: jax.Array,
    initial: jax.Array,
    discount: Numeric,
    visits: jax.Array,
) -> jax.Array:
    """D_0 + gamma P^T (d pi) of discounted visits d, `[S]` -> `[S]`."""
    moved = dynamics_lib.next_distribution(dynamics, visits[:, None] * probabilities)
    return initial + discount * moved


def _move(
    dynamics: Dynamics,
    discount: Numeric,
    carry: tuple[jax.Array, jax.Array, jax.Array],
    probabilities: jax.Array,
) -> tuple[tuple[jax.Array, jax.Array, jax.Array], None]:
    """Move by one step. The carry: D_t `[S]`, gamma^t `[]`, and the sum so far `[S, A]`."""
    distribution, weight, total = carry
    visits = distribution[:, None] * probabilities
    moved = dynamics_lib.next_distribution(dynamics, visits)
    return (moved, weight * discount, total + weight * visits), None
