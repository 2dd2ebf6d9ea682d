"""How the learned reward joins the environment's (the paper, section 3.3)."""

from typing import Literal

import jax
import jax.numpy as jnp

from cmedirl_jax import checks, ranges
from cmedirl_jax.types import Numeric

Shaping = Literal["additive", "potential", "alone"]


def additive(
    environment_reward: jax.Array, learned_reward: jax.Array, weight: Numeric = 1.0
) -> jax.Array:
    """r* = r_e + weight r_D (Eq. 10, where the weight is 1).

    Args:
        environment_reward: `[...]`, r_e.
        learned_reward: `[...]`, r_D.
        weight: `[]`, of r_D; lower it over time to anneal r_D.

    Raises:
        ValueError: if the shapes differ, or the weight is not a finite scalar.
        TypeError: if the rewards are not of floats.
    """
    _check(weight, environment_reward=environment_reward, learned_reward=learned_reward)
    return environment_reward + weight * learned_reward


def potential(
    environment_reward: jax.Array,
    before: jax.Array,
    after: jax.Array,
    terminated: jax.Array,
    discount: Numeric,
    weight: Numeric = 1.0,
) -> jax.Array:
    """r* = r_e + weight (discount Phi(s') - Phi(s)), which keeps the optimal policies optimal.

    Ng, Harada and Russell 1999. Phi is 0 after a termination, but not after a truncation. The
    policies are not kept if the weight changes over time, or while Phi is still learned.

    Args:
        environment_reward: `[...]`, r_e.
        before: `[...]`, Phi(s).
        after: `[...]`, Phi(s').
        terminated: `[...]` bool.
        discount: `[]`, the agent's, per environment step.
        weight: `[]`, of the potential.

    Raises:
        ValueError: if the shapes differ, the weight is not a finite scalar, or the discount not one
            between 0 and 1.
        TypeError: if `terminated` is not bool, or another array is not of floats.
    """
    _check(weight, environment_reward=environment_reward, before=before, after=after)
    checks.shape("terminated", terminated, jnp.shape(environment_reward))
    checks.kind("terminated", terminated, jnp.bool_)
    checks.shape("discount", discount, ())
    checks.shares(discount=discount)
    following = jnp.where(terminated, 0.0, after)
    return environment_reward + weight * (discount * following - before)


def _check(weight: Numeric, **rewards: jax.Array) -> None:
    for name, reward in rewards.items():
        checks.shape(name, reward, jnp.shape(rewards["environment_reward"]))
        checks.kind(name, reward, jnp.floating)
    checks.shape("weight", weight, ())
    checks.within(ranges.FINITE, weight=weight)
