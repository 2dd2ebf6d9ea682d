"""The data term of the log-likelihood, L_D, estimated from samples.

The derivative of each by the rewards is mu_D - E[mu] (Eqs. 6 and 8): the demonstrations' empirical
visitation minus that of weighted samples. They differ in the weights `w`, which sum to one:

- `visitation`: w ~ z. The plain difference of two means; linear in the reward, so nothing in it
  holds the reward back.
- `transition`: w ~ z exp r(s, a). Every sampled pair is a trajectory of its own.
- `trajectory`: w ~ z exp R(tau), Guided Cost Learning (Finn et al. 2016, Algorithm 2).

`z` is the derivative of the base measure (see `irl.densities`) by the law that the samples came
from: uniform, or 1 / density. Appending the demonstrations to the samples (Algorithm 1, line 4)
keeps the two exponential objectives bounded; the linear one it only rescales.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax.types import Numeric

Objective = Literal["visitation", "transition", "trajectory"]


class Scored(NamedTuple):
    """A batch under a reward, `[...]` being `[B]` for pairs and `[M]` for trajectories.

    Attributes:
        reward: `[...]`, r(s, a) of each pair, or the return R(tau) of each trajectory.
        log_weight: `[...]`, log z; -inf leaves an entry out of the samples.
        mask: `[...]` bool; False leaves it out altogether.
    """

    reward: jax.Array
    log_weight: jax.Array
    mask: jax.Array


class Likelihood(NamedTuple):
    """An estimate.

    Attributes:
        value: `[]`, L_D up to a constant.
        effective_sample_size: `[]`, (sum w)^2 / sum w^2, of at most as many as there are samples.
    """

    value: jax.Array
    effective_sample_size: jax.Array


def visitation(demonstrations: Scored, background: Scored, *, append: bool) -> Likelihood:
    """mean_D r - sum_i w_i r_i with w_i ~ z_i, over pairs (Eq. 6).

    Args:
        demonstrations: scored pairs.
        background: scored pairs.
        append: whether the demonstrations join the samples (Algorithm 1, line 4).
    """
    samples = _samples(demonstrations, background, append)
    weight = _normalised(samples.log_weight, samples.mask)
    value = _mean(demonstrations) - jnp.sum(weight * samples.reward)
    return Likelihood(value, _effective_sample_size(weight))


def transition(demonstrations: Scored, background: Scored, *, append: bool) -> Likelihood:
    """mean_D r - log mean_i [z_i exp r_i], over pairs.

    At the optimum over all functions, with the demonstrations appended: for uniform z,
    r = log(rho_D / mixture) + c; for z = 1 / b_mix(a|s), r = log(rho_D(s, a) / mixture(s)) + c,
    where `mixture` is the law of the samples.

    Args:
        demonstrations: scored pairs.
        background: scored pairs.
        append: whether the demonstrations join the samples.
    """
    return _log_partition_likelihood(demonstrations, background, append)


def trajectory(demonstrations: Scored, background: Scored, *, append: bool) -> Likelihood:
    """mean_D R - log mean_j [z_j exp R_j], over trajectories (Guided Cost Learning).

    With R undiscounted, deterministic dynamics and one start this is, in the limit of many samples,
    the exact likelihood of `tabular.maxent`. With a discounted R it is not.

    Args:
        demonstrations: scored trajectories; their returns are those of `returns`.
        background: scored trajectories.
        append: whether the demonstrations join the samples.
    """
    return _log_partition_likelihood(demonstrations, background, append)


def returns(reward: jax.Array, mask: jax.Array, discount: Numeric = 1.0) -> jax.Array:
    """R(tau) = sum_t discount^t r_t over the steps of `mask`: `[..., T]` -> `[...]`."""
    steps = jnp.arange(reward.shape[-1])
    return jnp.sum(jnp.where(mask, discount**steps * reward, 0.0), axis=-1)


def log_weights(
    log_density: jax.Array,
    mask: jax.Array,
    *,
    exponent: Numeric = 1.0,
    limit: Numeric | None = None,
) -> jax.Array:
    """log z of samples of a given log density, tempered and clipped: `[B]` -> `[B]`.

    Tempering and clipping trade the weights' bias for their variance; over the hundreds of steps of
    a trajectory the weights collapse onto one sample without them.

    Args:
        log_density: with respect to the base measure; +inf gives weight 0.
        mask: which samples count.
        exponent: z^exponent in place of z; 0 gives uniform weights.
        limit: largest distance of log z^exponent from its mean; None for any.
    """
    counts = mask & jnp.isfinite(log_density)
    log_z = -exponent * jnp.where(counts, log_density, 0.0)
    if limit is not None:
        centre = jnp.sum(jnp.where(counts, log_z, 0.0)) / jnp.maximum(jnp.sum(counts), 1)
        log_z = jnp.clip(log_z, centre - limit, centre + limit)
    return jnp.where(jnp.isposinf(log_density), -jnp.inf, log_z)


def _log_partition_likelihood(
    demonstrations: Scored, background: Scored, append: bool
) -> Likelihood:
    samples = _samples(demonstrations, background, append)
    exponent = samples.reward + samples.log_weight
    counts = samples.mask & (samples.log_weight > -jnp.inf)
    # Where nothing counts the partition function is taken for one: there is no gradient to give.
    some = jnp.any(counts)
    log_sum = jax.nn.logsumexp(jnp.where(some, exponent, 0.0), where=counts | ~some)
    log_mean = log_sum - jnp.log(jnp.maximum(jnp.sum(samples.mask), 1))
    value = _mean(demonstrations) - jnp.where(some, log_mean, 0.0)
    return Likelihood(value, _effective_sample_size(_normalised(exponent, samples.mask)))


def _samples(demonstrations: Scored, background: Scored, append: bool) -> Scored:
    if not append:
        return background
    return Scored(*map(jnp.concatenate, zip(demonstrations, background, strict=True)))


def _mean(scored: Scored) -> jax.Array:
    total = jnp.sum(jnp.where(scored.mask, scored.reward, 0.0))
    return total / jnp.maximum(jnp.sum(scored.mask), 1)


def _normalised(log_weight: jax.Array, mask: jax.Array) -> jax.Array:
    """Weights that sum to one, or are all zero where there is none."""
    counts = mask & (log_weight > -jnp.inf)
    largest = jax.lax.stop_gradient(jnp.max(log_weight, initial=-jnp.inf, where=counts))
    weight = jnp.where(counts, jnp.exp(jnp.where(counts, log_weight - largest, 0.0)), 0.0)
    return weight / jnp.maximum(jnp.sum(weight), 1.0)


def _effective_sample_size(weight: jax.Array) -> jax.Array:
    weight = jax.lax.stop_gradient(weight)
    total = jnp.sum(jnp.square(weight))
    return jnp.where(total > 0, 1.0 / jnp.where(total > 0, total, 1.0), 0.0)
