"""How the learned reward joins the environment's (the paper, section 3.3)."""

from typing import Literal

import jax
import jax.numpy as jnp

from cmedirl_jax import checks
from cmedirl_jax.types import Numeric

Shaping = Literal["additive", "potential", "alone"]


def additive(
    environment_reward: jax.Array, learned_reward: jax.Array, weight: Numeric = 1.0
) -> jax.Array:
    """r* = r_e + weight r_D (Eq. 10, where the weight is 1; annealed, it falls).

    Args:
        environment_reward: `[...]`, r_e.
        learned_reward: `[...]`, r_D.
        weight: `[]`, of r_D.

    Raises:
        ValueError: if the shapes differ, or the weight is no scalar.
        TypeError: if the rewards are not floats.
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
    """r* = r_e + weight (discount Phi(s') - Phi(s)), which leaves every optimal policy optimal.

    Ng, Harada and Russell 1999. Phi is 0 past a termination, not past a truncation. With a weight
    that changes over time, or a Phi that is still learned, the invariance is lost.

    Args:
        environment_reward: `[...]`, r_e.
        before: `[...]`, Phi(s).
        after: `[...]`, Phi(s').
        terminated: `[...]` bool.
        discount: `[]`, the agent's.
        weight: `[]`, of the potential.

    Raises:
        ValueError: if the shapes differ, or the discount or the weight is no scalar.
        TypeError: if `terminated` is not bool, or another array is not of floats.
    """
    _check(weight, environment_reward=environment_reward, before=before, after=after)
    checks.shape("terminated", terminated, jnp.shape(environment_reward))
    checks.kind("terminated", terminated, jnp.bool_)
    checks.shape("discount", discount, ())
    following = jnp.where(terminated, 0.0, after)
    return environment_reward + weight * (discount * following - before)


def _check(weight: Numeric, **rewards: jax.Array) -> None:
    for name, reward in rewards.items():
        checks.shape(name, reward, jnp.shape(rewards["environment_reward"]))
        checks.kind(name, reward, jnp.floating)
    checks.shape("weight", weight, ())
