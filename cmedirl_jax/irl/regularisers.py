"""What keeps a learned reward regular: priors, penalties, bounds, a gauge, absorbing states.

A constant added to r_D is not identified by demonstrations, but it changes the policy in an
episodic task: loitering beats finishing once r_D > (1 - gamma) / gamma times the reward of
finishing. Hence bounds and a gauge; absorbing states are the other remedy.
"""

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax

from cmedirl_jax.types import Numeric, Params

BoundKind = Literal["tanh", "clip", "none"]
Gauge = Literal["none", "zero-mean", "demonstration-maximum"]


def log_prior(params: Params, precision: Numeric) -> jax.Array:
    """log P(theta) = -precision / 2 ||theta||^2 up to its constant (Eq. 4), `[]`."""
    return -0.5 * precision * optax.tree.norm(params, squared=True)


def output_penalty(output: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean of f^2 over the entries of `mask`: `[B]` -> `[]`."""
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
        mask: `[B]` bool, which of them count.
        scale: units of observations `[O]` and actions `[A]` in which the gradient is measured.
        target: of the gradient's norm.
    """
    by_pair = jax.vmap(jax.grad(function, argnums=(0, 1)))(observation, action)
    squared = sum(
        jnp.sum(jnp.square(slope * unit), axis=-1)
        for slope, unit in zip(by_pair, scale, strict=True)
    )
    # The root has no derivative at zero, where a plain square does.
    steep = squared > 1e-12
    norm = jnp.where(steep, jnp.sqrt(jnp.where(steep, squared, 1.0)), 0.0)
    return masked_mean(squared - 2.0 * target * norm + target**2, mask)


def interpolate(key: jax.Array, demonstrations: Any, background: Any) -> Any:
    """Points at a random place between the first pairs of one batch and those of the other.

    Args:
        key: randomness.
        demonstrations: any pytree with leaves `[D, ...]`.
        background: the same with leaves `[B, ...]`.

    Returns:
        The pytree with leaves `[min(D, B), ...]`.
    """
    size = min(jax.tree.leaves(tree)[0].shape[0] for tree in (demonstrations, background))
    share = jax.random.uniform(key, (size,))

    def between(demonstrated: jax.Array, sampled: jax.Array) -> jax.Array:
        weight = share.reshape(size, *(1,) * (demonstrated.ndim - 1))
        return weight * demonstrated[:size] + (1.0 - weight) * sampled[:size]

    return jax.tree.map(between, demonstrations, background)


def bounded(output: jax.Array, bound: Numeric, kind: BoundKind = "tanh") -> jax.Array:
    """r_D of f, `[...]` -> `[...]`.

    - "tanh": bound * tanh(f), |r_D| < bound everywhere.
    - "clip": f clipped to +-bound. Past it nothing but the penalty on f brings f back.
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
    """The constant that the gauge takes off r_D, `[]`, on a batch of each; 0 on an empty one.

    - "none": 0.
    - "zero-mean": the mean of r_D over the background.
    - "demonstration-maximum": the largest r_D of the demonstrations, so that demonstrated pairs
      earn about nothing at best; the learner follows it batch by batch.

    Args:
        kind: which.
        demonstrations: r_D of the demonstrated pairs `[D]`, and their mask.
        background: r_D of the background pairs `[B]`, and their mask.
    """
    match kind:
        case "none":
            return jnp.zeros(())
        case "zero-mean":
            return masked_mean(*background)
        case "demonstration-maximum":
            reward, mask = demonstrations
            largest = jnp.max(reward, initial=-jnp.inf, where=mask)
            return jnp.where(jnp.any(mask), largest, 0.0)


def absorbed_reward(absorbing: jax.Array, terminated: jax.Array, discount: Numeric) -> jax.Array:
    """What a transition earns after its end: discount / (1 - discount) r_D(absorbing), `[...]`.

    An episode that terminates goes on for ever in an absorbing state whose reward is learned too
    (Kostrikov et al. 2019, "Discriminator-Actor-Critic", section 4.2), summed up at once.

    Args:
        absorbing: `[]`, r_D of the absorbing state.
        terminated: `[...]` bool.
        discount: the agent's, below 1.
    """
    return jnp.where(terminated, discount / (1.0 - discount) * absorbing, 0.0)


def masked_mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean over the entries of `mask`, 0 where there is none: `[...]` -> `[]`."""
    return jnp.sum(jnp.where(mask, values, 0.0)) / jnp.maximum(jnp.sum(mask), 1)
