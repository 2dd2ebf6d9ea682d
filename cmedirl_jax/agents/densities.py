"""Densities of behaviour policies, by which sampled actions estimate Z = integral of exp r.

An action `a` drawn from a law of density b gives the unbiased estimate z exp r(a) of Z, z = 1 / b.
This requires that b is nowhere zero and is a density with respect to the measure of the integral.
That base measure is, in each dimension, the Lebesgue measure inside the action bounds and a unit
mass at each bound, where clipping puts an atom. Where a law has an atom elsewhere its density is
infinite, so z = 0. A law without mass at the bounds estimates the integral over the inside alone.

All functions return logarithms; -inf is a density of zero. Shapes: observations `[..., O]`, actions
`[..., A]`, densities `[...]`.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import modes
from cmedirl_jax.types import Array, EnvSpec, Numeric

SCALE_FLOOR = 1e-2
"""The smallest standard deviation of a fitted Gaussian, in half-widths of the action range."""


class ConditionalGaussian(NamedTuple):
    """The law N((1, s) coefficients, diag(scale^2)) of an action.

    Attributes:
        coefficients: `[O + 1, A]`, with the intercept first.
        scale: `[A]`, standard deviations, in units of the action.
    """

    coefficients: jax.Array
    scale: jax.Array


def clipped_normal(spec: EnvSpec, mean: Array, scale: Array, action: Array) -> jax.Array:
    """Log density of clip(N(mean, diag(scale^2))); each bound has the mass of the tail beyond it.

    Args:
        spec: the action bounds.
        mean: `[..., A]`.
        scale: standard deviations, `[..., A]`, in units of the action.
        action: `[..., A]`, inside the bounds or on them.
    """
    low, high, mean, scale, action = modes.align(
        spec.action_low, spec.action_high, mean, scale, action
    )
    inside = -0.5 * jnp.square((action - mean) / scale) - jnp.log(scale * math.sqrt(2 * math.pi))
    at_low = jax.scipy.stats.norm.logcdf((low - mean) / scale)
    at_high = jax.scipy.stats.norm.logcdf((mean - high) / scale)
    log_density = jnp.where(action <= low, at_low, jnp.where(action >= high, at_high, inside))
    return jnp.sum(log_density, axis=-1)


def epsilon_greedy(
    spec: EnvSpec,
    epsilon: Numeric,
    greedy: Array,
    action: Array,
    noise: Array | None = None,
) -> jax.Array:
    """Log density of a uniform action with probability epsilon, else of the greedy one.

    Without noise it is log(epsilon / volume), and inf at the atom. The atom is where `action` and
    `greedy` are equal in every bit, so compute the density in the program that computes mu(s):
    another one may round differently.

    Args:
        spec: the action bounds.
        epsilon: probability of a uniform action, `[...]`.
        greedy: `[..., A]`.
        action: `[..., A]`.
        noise: standard deviations of clipped Gaussian noise on the greedy action, `[..., A]`, in
            units of the action; None: no noise.
    """
    uniform = jnp.log(epsilon) - log_volume(spec)
    greedy, action, low, high = modes.align(greedy, action, spec.action_low, spec.action_high)
    if noise is None:
        return jnp.where(jnp.all(action == greedy, axis=-1), jnp.inf, uniform)
    inside = jnp.all((action > low) & (action < high), axis=-1)
    return jnp.logaddexp(
        jnp.where(inside, uniform, -jnp.inf),
        jnp.log1p(-epsilon) + clipped_normal(spec, greedy, noise, action),
    )


def log_volume(spec: EnvSpec) -> np.floating:
    """Log of the volume inside the action bounds; a uniform action's log density is minus that."""
    return np.sum(np.log(spec.action_high - spec.action_low))


def transition_mixture(log_densities: jax.Array, filled: jax.Array | None = None) -> jax.Array:
    """Log density of an action when each step draws one of `K` policies: log mean_k q_k(a|s).

    Args:
        log_densities: log q_k(a|s), `[K, ...]`; an inf makes the result inf.
        filled: `[K]` bool, which policies are in the mixture, at least one; default all.

    Returns:
        `[...]`.
    """
    if filled is not None:
        filled = filled.reshape(-1, *[1] * (log_densities.ndim - 1))
    return jax.nn.logmeanexp(log_densities, axis=0, where=filled)


def trajectory_mixture(
    log_densities: jax.Array, steps: jax.Array, filled: jax.Array | None = None
) -> jax.Array:
    """Log density of trajectories when each trajectory draws one of `K` policies.

    It is log mean_k exp(sum_t log q_k(a_t|s_t)). The mean at each step would be right for
    trajectories whose policy changes from step to step.

    Args:
        log_densities: log q_k(a_t|s_t), `[K, ..., T]`.
        steps: `[..., T]` bool, which entries are steps of the trajectory; the others are ignored.
        filled: `[K]` bool, which policies are in the mixture, at least one; default all.

    Returns:
        `[...]`.
    """
    taken = jnp.where(steps[None], log_densities, 0.0)
    # A policy that never takes one of the actions has density 0, whatever atoms the others have.
    impossible = jnp.any(taken == -jnp.inf, axis=-1)
    total = jnp.sum(jnp.where(impossible[..., None], 0.0, taken), axis=-1)
    return transition_mixture(jnp.where(impossible, -jnp.inf, total), filled)


def fit_gaussian(
    spec: EnvSpec, observation: Array, action: Array, weight: Array | None = None
) -> ConditionalGaussian:
    """Fit a Gaussian, affine in the observation, to demonstrated actions: it approximates b(a|s).

    The mean is the least-squares fit of the action to (1, s). The scale is the residuals' root mean
    square, at least `SCALE_FLOOR`. A demonstrated action on a bound is fitted as that value, not as
    a clipped one.

    Args:
        spec: the action bounds.
        observation: `[N, O]`.
        action: `[N, A]`.
        weight: `[N]`, of each pair, not all zero; default equal.
    """
    weight = jnp.ones(len(observation), jnp.float32) if weight is None else weight
    average = functools.partial(jnp.average, axis=0, weights=weight, keepdims=True)
    mean, action_mean = average(observation), average(action)
    spread = jnp.sqrt(average(jnp.square(observation - mean)))
    # Constant features carry only rounding error: do not rescale them.
    spread = jnp.where(spread > 1e-6 * jnp.abs(mean), spread, jnp.inf)
    standard = (observation - mean) / spread
    share = (weight / jnp.sum(weight))[:, None]
    # Conjugate gradients end after O steps, and give zero for constant features. LAPACK's
    # factorisations can deadlock on Python's lock when dispatched to several CPU devices.
    slopes, _ = jax.scipy.sparse.linalg.cg(
        lambda slopes: standard.T @ (share * (standard @ slopes)),
        standard.T @ (share * (action - action_mean)),
        tol=1e-6,
        maxiter=4 * standard.shape[1],
    )
    residual = action - action_mean - standard @ slopes
    slopes = slopes / spread.T
    floor = 0.5 * SCALE_FLOOR * (spec.action_high - spec.action_low)
    return ConditionalGaussian(
        jnp.concatenate([action_mean - (mean[0] @ slopes)[None], slopes]),
        jnp.maximum(jnp.sqrt(average(jnp.square(residual))[0]), floor),
    )


def gaussian_policy(
    spec: EnvSpec, fitted: ConditionalGaussian, observation: Array, action: Array
) -> jax.Array:
    """Log density `[...]` of the fitted Gaussian, clipped to the bounds.

    It stands in for the demonstrators' unknown law, so estimates of Z made with it are approximate.

    Args:
        spec: the action bounds.
        fitted: what `fit_gaussian` gave.
        observation: `[..., O]`.
        action: `[..., A]`.
    """
    intercept, slope = modes.align(fitted.coefficients[0], observation @ fitted.coefficients[1:])
    return clipped_normal(spec, intercept + slope, fitted.scale, action)
