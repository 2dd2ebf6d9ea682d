"""Densities of behaviour laws, by which sampled actions estimate Z = integral of exp r.

An action `a` drawn from a law of density b estimates Z without bias by z exp r(a), z = 1 / b, if b
is with respect to the measure that Z integrates over and nowhere zero. Here that is the base
measure: in each dimension the Lebesgue measure inside the action bounds and a unit mass at each
bound, where clipping puts an atom. A law with an atom elsewhere has density infinity there: z = 0.
A law without mass at the bounds estimates the integral over the inside alone.

Densities are logarithms; a density is zero at -inf. Shapes: observations `[..., O]`, actions
`[..., A]`, densities `[...]`.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.types import Array, EnvSpec, Numeric

SCALE_FLOOR = 1e-2
"""The smallest standard deviation of a fitted Gaussian, in half-widths of the action range."""


class ConditionalGaussian(NamedTuple):
    """N((1, s) coefficients, diag(scale^2)).

    Attributes:
        coefficients: `[O + 1, A]`, the intercept first.
        scale: `[A]`, standard deviations, in units of the action.
    """

    coefficients: jax.Array
    scale: jax.Array


def clipped_normal(spec: EnvSpec, mean: Array, scale: Array, action: Array) -> jax.Array:
    """Log density of clip(N(mean, diag(scale^2))): the tails' masses at the bounds.

    Args:
        spec: the action bounds.
        mean: `[..., A]`.
        scale: standard deviations, `[..., A]`, in units of the action.
        action: `[..., A]`, inside the bounds or on them.
    """
    low, high = spec.action_low, spec.action_high
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
    """Log density of: uniform inside the bounds with probability epsilon, greedy otherwise.

    Without noise it is log(epsilon / volume), and inf at the atom, where `action` equals `greedy`
    in every bit: mu(s) computed in another program may round otherwise, a recorded density cannot.

    Args:
        spec: the action bounds.
        epsilon: probability of a uniform action, `[...]`.
        greedy: `[..., A]`.
        action: `[..., A]`.
        noise: standard deviations of Gaussian noise on the greedy action, clipped, `[..., A]` in
            units of the action; None for none.
    """
    uniform = jnp.log(epsilon) - log_volume(spec)
    if noise is None:
        return jnp.where(jnp.all(action == greedy, axis=-1), jnp.inf, uniform)
    inside = jnp.all((action > spec.action_low) & (action < spec.action_high), axis=-1)
    return jnp.logaddexp(
        jnp.where(inside, uniform, -jnp.inf),
        jnp.log1p(-epsilon) + clipped_normal(spec, greedy, noise, action),
    )


def log_volume(spec: EnvSpec) -> np.floating:
    """Logarithm of the volume inside the action bounds: minus a uniform action's log density."""
    return np.sum(np.log(spec.action_high - spec.action_low))


def transition_mixture(log_densities: jax.Array, filled: jax.Array | None = None) -> jax.Array:
    """Log density of actions of `K` policies mixed step by step, log mean_k q_k(a|s): `[...]`.

    Args:
        log_densities: log q_k(a|s), `[K, ...]`; inf in one makes the mixture's inf.
        filled: which components there are, `[K]` bool, at least one; default all.
    """
    if filled is not None:
        filled = filled.reshape(-1, *[1] * (log_densities.ndim - 1))
    return jax.nn.logmeanexp(log_densities, axis=0, where=filled)


def trajectory_mixture(
    log_densities: jax.Array, steps: jax.Array, filled: jax.Array | None = None
) -> jax.Array:
    """Log density of the actions of whole trajectories, each of one of `K` policies: `[...]`.

    log mean_k exp(sum_t log q_k(a_t|s_t)); the mean at each step would be of trajectories whose
    policy changes from step to step.

    Args:
        log_densities: log q_k(a_t|s_t), `[K, ..., T]`.
        steps: which of them are steps of the trajectory, `[..., T]` bool; the others count nothing.
        filled: which components there are, `[K]` bool, at least one; default all.
    """
    taken = jnp.where(steps, log_densities, 0.0)
    # An action that a policy never takes outweighs any atom among the others: not inf - inf.
    impossible = jnp.any(taken == -jnp.inf, axis=-1)
    total = jnp.sum(jnp.where(impossible[..., None], 0.0, taken), axis=-1)
    return transition_mixture(jnp.where(impossible, -jnp.inf, total), filled)


def fit_gaussian(
    spec: EnvSpec, observation: Array, action: Array, weight: Array | None = None
) -> ConditionalGaussian:
    """The Gaussian, affine in the observation, of demonstrated actions: an approximation of b(a|s).

    Least squares of the action on (1, s); the scale is the residuals' root mean square, or
    `SCALE_FLOOR`. A bound that was demonstrated counts as the value it is, not as a clipped one.

    Args:
        spec: the action bounds.
        observation: `[N, O]`.
        action: `[N, A]`.
        weight: of each pair, `[N]`, not all zero; default equal.
    """
    weight = jnp.ones(len(observation)) if weight is None else weight
    mean, action_mean = (jnp.average(x, 0, weight) for x in (observation, action))
    spread = jnp.sqrt(jnp.average(jnp.square(observation - mean), 0, weight))
    # Of what does not vary there is only the mean's rounding, which is not to be scaled up.
    spread = jnp.where(spread > 1e-6 * jnp.abs(mean), spread, jnp.inf)
    standard = (observation - mean) / spread
    share = (weight / jnp.sum(weight))[:, None]
    # Conjugate gradients end after O steps, and stay at zero where nothing varies. A factorisation
    # by LAPACK, dispatched ahead to several CPU devices, can wait for Python's lock for ever.
    slopes, _ = jax.scipy.sparse.linalg.cg(
        lambda slopes: standard.T @ (share * (standard @ slopes)),
        standard.T @ (share * (action - action_mean)),
        tol=1e-6,
        maxiter=4 * standard.shape[1],
    )
    residual = action - action_mean - standard @ slopes
    slopes = slopes / spread[:, None]
    floor = 0.5 * SCALE_FLOOR * (spec.action_high - spec.action_low)
    return ConditionalGaussian(
        jnp.concatenate([(action_mean - mean @ slopes)[None], slopes]),
        jnp.maximum(jnp.sqrt(jnp.average(jnp.square(residual), 0, weight)), floor),
    )


def gaussian_policy(
    spec: EnvSpec, fitted: ConditionalGaussian, observation: Array, action: Array
) -> jax.Array:
    """Log density `[...]` of the fitted Gaussian, clipped: `[..., O]`, `[..., A]`.

    It stands in for the demonstrators' unknown law; its estimates of Z are as good as it is.
    """
    mean = fitted.coefficients[0] + observation @ fitted.coefficients[1:]
    return clipped_normal(spec, mean, fitted.scale, action)
