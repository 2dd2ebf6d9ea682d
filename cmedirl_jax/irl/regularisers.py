"""What keeps a learned reward regular: priors, penalties, bounds, a gauge, absorbing states.

Demonstrations do not identify a constant that is added to r_D, but the constant changes the policy
in an episodic task: staying alive is better than finishing once r_D exceeds (1 - gamma) / gamma
times the reward of finishing. Bounds and a gauge prevent this; so do absorbing states.
"""

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import observation_statistics
from cmedirl_jax.types import Numeric, Params

BoundKind = Literal["tanh", "clip", "none"]
Gauge = Literal["none", "zero-mean", "demonstration-maximum"]


def log_prior(params: Params, precision: Numeric) -> jax.Array:
    """log P(theta) = -precision / 2 ||theta||^2 up to its constant (Eq. 4), `[]`.

    Statistics among the parameters do not count.
    """
    return -0.5 * precision * optax.tree.norm(observation_statistics.trained(params), squared=True)


def output_penalty(output: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean of f^2 over the entries where `mask` is True: `[B]` -> `[]`."""
    return masked_mean(jnp.square(output), mask)


def gradient_penalty(
    function: Callable[[jax.Array, jax.Array], jax.Array],
    observation: jax.Array,
    action: jax.Array,
    mask: jax.Array,
    *,
    scale: tuple[jax.Array, jax.Array],
    target: Numeric = 0.0,
) -> jax.Array:
    """Mean of (|df/d(s, a)| - target)^2 (Gulrajani et al. 2017, whose target is 1), `[]`.

    Args:
        function: f of one pair, `[O]`, `[A]` -> `[]`.
        observation: `[B, O]`, where the gradient is taken; see `interpolate`.
        action: `[B, A]`.
        mask: `[B]` bool, which pairs count.
        scale: the gradient's units, of observations `[O]` and of actions `[A]`.
        target: the norm of the gradient that is not penalised.
    """
    by_pair = jax.vmap(jax.grad(function, argnums=(0, 1)))(observation, action)
    squared = sum(
        jnp.sum(jnp.square(slope * unit[None]), axis=-1)
        for slope, unit in zip(by_pair, scale, strict=True)
    )
    # The square root has no derivative at zero.
    steep = squared > 1e-12
    norm = jnp.where(steep, jnp.sqrt(jnp.where(steep, squared, 1.0)), 0.0)
    return masked_mean(squared - 2.0 * target * norm + target**2, mask)


def interpolate(key: jax.Array, demonstrations: Any, background: Any) -> Any:
    """Random points on the lines between the entries of two batches.

    Args:
        key: randomness.
        demonstrations: a pytree with leaves `[D, ...]`.
        background: a pytree of the same structure with leaves `[B, ...]`.

    Returns:
        A pytree with leaves `[min(D, B), ...]`.
    """
    size = min(jax.tree.leaves(tree)[0].shape[0] for tree in (demonstrations, background))
    share = jax.random.uniform(key, (size,), jnp.float32)

    def between(demonstrated: jax.Array, sampled: jax.Array) -> jax.Array:
        weight = share.reshape(size, *(1,) * (demonstrated.ndim - 1))
        return weight * demonstrated[:size] + (1.0 - weight) * sampled[:size]

    return jax.tree.map(between, demonstrations, background)


def bounded(output: jax.Array, bound: Numeric, kind: BoundKind = "tanh") -> jax.Array:
    """r_D of f, `[...]` -> `[...]`.

    - "tanh": bound * tanh(f), |r_D| < bound everywhere.
    - "clip": f clipped to +-bound. Beyond the bound only the penalty on f has a gradient.
    - "none": f.
    """
    match kind:
        case "tanh":
            return bound * jnp.tanh(output)
        case "clip":
            return jnp.clip(output, -bound, bound)
        case "none":
            return output


def gauge_offset(
    kind: Gauge,
    demonstrations: tuple[jax.Array, jax.Array],
    background: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """The constant `[]` that the gauge subtracts from r_D, estimated on batches; 0 on empty ones.

    - "none": 0.
    - "zero-mean": the mean of r_D over the background.
    - "demonstration-maximum": the largest r_D of the demonstrations, so that demonstrated pairs
      earn at most about zero.

    Args:
        kind: which gauge.
        demonstrations: r_D of the demonstrated pairs `[D]`, and their mask.
        background: r_D of the background pairs `[B]`, and their mask.
    """
    match kind:
        case "none":
            return jnp.zeros((), jnp.float32)
        case "zero-mean":
            return masked_mean(*background)
        case "demonstration-maximum":
            reward, mask = demonstrations
            largest = jnp.max(reward, initial=-jnp.inf, where=mask)
            return jnp.where(jnp.any(mask), largest, 0.0)


def absorbed_reward(absorbing: jax.Array, terminated: jax.Array, discount: Numeric) -> jax.Array:
    """What follows a termination: discount / (1 - discount) r_D(absorbing), else 0: `[...]`.

    An episode that terminates goes on for ever in an absorbing state whose reward is learned too
    (Kostrikov et al. 2019, "Discriminator-Actor-Critic", section 4.2). This is the sum of all those
    rewards.

    Args:
        absorbing: `[]`, r_D of the absorbing state.
        terminated: `[...]` bool.
        discount: the agent's, below 1, per environment step.
    """
    return jnp.where(terminated, discount / (1.0 - discount) * absorbing, 0.0)


def masked_mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean over the entries where `mask` is True, 0 if there is none: `[...]` -> `[]`."""
    return jnp.sum(jnp.where(mask, values, 0.0)) / jnp.maximum(jnp.sum(mask), 1)
