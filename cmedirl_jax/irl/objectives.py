"""The data term of the log-likelihood, L_D, estimated from samples.

The derivative of each objective by a sample's `Scored.reward` (r of a pair, R of a trajectory) is
the sample's frequency among the demonstrations minus its weight among the samples. Each sums to
one, and the difference estimates mu_D - E[mu] (Eqs. 6 and 8). The objectives differ in the weights
`w`:

- `visitation`: w ~ z. The plain difference of two means. It is linear in the reward and does not
  bound it.
- `transition`: w ~ z exp r(s, a). Every sampled pair is a trajectory of its own.
- `trajectory`: w ~ z exp R(tau), Guided Cost Learning (Finn et al. 2016, Algorithm 2).

`z` is 1, or the importance weight 1 / density, where the density of the samples' law is with
respect to the base measure of `agents.densities`. Appending the demonstrations to the samples
(Algorithm 1, line 4) bounds the two exponential objectives. It only rescales the linear one with
uniform weights.

A new objective needs, all in this file: its function, its name in `ObjectiveName`, and an entry in
`OBJECTIVES`.
"""

import functools
from typing import Annotated, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from cmedirl_jax import modes, ranges
from cmedirl_jax.irl.regularisers import masked_mean
from cmedirl_jax.registries import Registry
from cmedirl_jax.types import Numeric, RewardBatch

ObjectiveName = Annotated[Literal["visitation", "transition", "trajectory"], ranges.Registered]
"""The names in `OBJECTIVES`."""


class Scored(NamedTuple):
    """A batch under a reward. `[...]` is `[B]` for pairs and `[M]` for trajectories.

    Attributes:
        reward: `[...]`, r(s, a) of each pair, or the return R(tau) of each trajectory.
        log_weight: `[...]`, log z; -inf leaves an entry out of the samples.
        mask: `[...]` bool; False leaves an entry out of the demonstrations too.
    """

    reward: jax.Array
    log_weight: jax.Array
    mask: jax.Array


class Likelihood(NamedTuple):
    """An estimate of L_D.

    Attributes:
        value: `[]`, L_D up to a constant.
        effective_sample_size: `[]`, (sum w)^2 / sum w^2, at most the number of samples.
    """

    value: jax.Array
    effective_sample_size: jax.Array


class LikelihoodFn(Protocol):
    """An estimate of L_D."""

    def __call__(self, demonstrations: Scored, background: Scored, *, append: bool) -> Likelihood:
        """Estimate L_D; `append`: the demonstrations join the samples (Algorithm 1, line 4)."""
        ...


class ScoreFn(Protocol):
    """A batch under a reward."""

    def __call__(
        self,
        batch: RewardBatch,
        reward: jax.Array,
        absorbed: jax.Array | None,
        discount: Numeric,
    ) -> Scored:
        """Score a batch.

        Args:
            batch: pairs or trajectories.
            reward: `[B]` or `[M * T]`, r_D of each step of the batch.
            absorbed: `[]`, r_D of the absorbing state; None without one.
            discount: `[]`, of a trajectory's return.
        """
        ...


class Objective(NamedTuple):
    """All that belongs to an objective's name.

    Attributes:
        likelihood: see `LikelihoodFn`.
        score: see `ScoreFn`.
        trajectories: whether it takes batches of whole trajectories, not of pairs.
        needs_bound: whether the reward of an absorbing state has to be bounded by
            `IRLHParams.bounded_by`, because the objective does not bound it.
    """

    likelihood: LikelihoodFn
    score: ScoreFn
    trajectories: bool = False
    needs_bound: bool = False


def visitation(demonstrations: Scored, background: Scored, *, append: bool) -> Likelihood:
    """mean_D r - sum_i w_i r_i with w_i ~ z_i, over pairs (Eq. 6).

    Args:
        demonstrations: scored pairs.
        background: scored pairs.
        append: whether the demonstrations join the samples (Algorithm 1, line 4).
    """
    samples = _samples(demonstrations, background, append)
    counts = _counts(samples)
    weight = _normalised(samples.log_weight, counts)
    value = _mean(demonstrations) - jnp.sum(weight * samples.reward)
    return _likelihood(value, weight, jnp.any(counts))


def transition(demonstrations: Scored, background: Scored, *, append: bool) -> Likelihood:
    """mean_D r - log mean_i [z_i exp r_i], over pairs.

    With the demonstrations appended, the optimum over all functions is r = log(rho_D / mixture) + c
    for uniform z, and r = log(rho_D(s, a) / mixture(s)) + c for z = 1 / b_mix(a|s), where `mixture`
    is the law of the samples.

    Args:
        demonstrations: scored pairs.
        background: scored pairs.
        append: whether the demonstrations join the samples.
    """
    return _log_partition_likelihood(demonstrations, background, append)


def trajectory(demonstrations: Scored, background: Scored, *, append: bool) -> Likelihood:
    """mean_D R - log mean_j [z_j exp R_j], over trajectories (Guided Cost Learning).

    In the limit of many samples this is the exact likelihood of `tabular.maxent`, for an
    undiscounted R, deterministic dynamics and a single start.

    Args:
        demonstrations: scored trajectories.
        background: scored trajectories.
        append: whether the demonstrations join the samples.
    """
    return _log_partition_likelihood(demonstrations, background, append)


def score_pairs(
    batch: RewardBatch, reward: jax.Array, absorbed: jax.Array | None, discount: Numeric
) -> Scored:
    """Score pairs; one more sample, of the absorbing state, follows each termination."""
    del discount
    scored = Scored(reward, log_weight(batch.log_density), batch.mask)
    if absorbed is None:
        return scored
    follows = batch.mask & batch.transition.terminated
    after = Scored(jnp.full_like(reward, absorbed), scored.log_weight, follows)
    return Scored(*map(jnp.concatenate, zip(scored, after, strict=True)))


def score_trajectories(
    batch: RewardBatch, reward: jax.Array, absorbed: jax.Array | None, discount: Numeric
) -> Scored:
    """Score trajectories; after a termination the absorbing state takes the rest of the horizon."""
    mask, reward = batch.mask, reward.reshape(batch.mask.shape)
    some = jnp.any(mask, axis=-1)
    if absorbed is not None:
        reward = jnp.where(mask, reward, absorbed)
        mask |= jnp.any(mask & batch.transition.terminated, axis=-1, keepdims=True)
    total = returns(reward, mask, discount)
    return Scored(total, log_weight(batch.log_density), some)


def returns(reward: jax.Array, mask: jax.Array, discount: Numeric = 1.0) -> jax.Array:
    """R(tau) = sum_t discount^t r_t over the steps of `mask`: `[..., T]` -> `[...]`."""
    steps = jnp.arange(reward.shape[-1])
    weight, reward = modes.align(jnp.asarray(discount**steps, reward.dtype), reward)
    return jnp.sum(jnp.where(mask, weight * reward, 0.0), axis=-1)


def weighed(
    demonstrations: Scored,
    background: Scored,
    *,
    append: bool,
    exponent: Numeric = 1.0,
    limit: Numeric | None = None,
) -> tuple[Scored, Scored]:
    """Temper the weights of both batches, and clip them about the mean of the samples' logarithms.

    This reduces the weights' variance and adds a bias. Without it the weights of trajectories of
    hundreds of steps collapse onto one sample.

    Args:
        demonstrations: scored.
        background: scored.
        append: whether the demonstrations are among the samples.
        exponent: replaces z by z^exponent; 0 gives uniform weights.
        limit: largest distance of log z^exponent from its mean; None: no limit.
    """
    samples = _samples(demonstrations, background, append)
    counts = _counts(samples)
    centre = masked_mean(exponent * jnp.where(counts, samples.log_weight, 0.0), counts)

    weigh = functools.partial(_weigh, centre, exponent, limit)
    return weigh(demonstrations), weigh(background)


def _weigh(centre: jax.Array, exponent: Numeric, limit: Numeric | None, scored: Scored) -> Scored:
    # A weight of zero stays zero, whatever the exponent.
    some = scored.log_weight != -jnp.inf
    log_weight = exponent * jnp.where(some, scored.log_weight, 0.0)
    if limit is not None:
        log_weight = jnp.clip(log_weight, centre - limit, centre + limit)
    return scored._replace(log_weight=jnp.where(some, log_weight, -jnp.inf))


def log_weight(log_density: jax.Array) -> jax.Array:
    """log z = -log density, with respect to the base measure: `[B]` -> `[B]`.

    An infinite density, at an atom that the base measure lacks, gives weight 0. So does a density
    of zero: such a sample cannot come from this law.
    """
    return jnp.where(jnp.isinf(log_density), -jnp.inf, -log_density)


def _log_partition_likelihood(
    demonstrations: Scored, background: Scored, append: bool
) -> Likelihood:
    samples = _samples(demonstrations, background, append)
    exponent, counts = samples.reward + samples.log_weight, _counts(samples)
    some = jnp.any(counts)
    log_sum = jax.nn.logsumexp(jnp.where(some, exponent, 0.0), where=counts | ~some)
    log_mean = log_sum - jnp.log(jnp.maximum(jnp.sum(samples.mask), 1).astype(log_sum.dtype))
    weight = _normalised(exponent, counts)
    return _likelihood(_mean(demonstrations) - log_mean, weight, some)


def _likelihood(value: jax.Array, weight: jax.Array, some: jax.Array) -> Likelihood:
    """The estimate; zeros if there is no sample to compare the demonstrations with."""
    total = jnp.sum(jnp.square(jax.lax.stop_gradient(weight)))
    return Likelihood(
        value=jnp.where(some, value, 0.0),
        effective_sample_size=jnp.where(some, 1.0 / jnp.where(some, total, 1.0), 0.0),
    )


def _samples(demonstrations: Scored, background: Scored, append: bool) -> Scored:
    if not append:
        return background
    return Scored(*map(jnp.concatenate, zip(demonstrations, background, strict=True)))


def _counts(scored: Scored) -> jax.Array:
    return scored.mask & (scored.log_weight != -jnp.inf)


def _mean(scored: Scored) -> jax.Array:
    return masked_mean(scored.reward, scored.mask)


def _normalised(log_weight: jax.Array, counts: jax.Array) -> jax.Array:
    """Weights with sum one; all zero if no entry counts."""
    # Finite where nothing counts: inf - inf is NaN, though it is not taken.
    lowest = jnp.finfo(log_weight.dtype).min
    largest = jax.lax.stop_gradient(jnp.max(log_weight, initial=lowest, where=counts))
    weight = jnp.where(counts, jnp.exp(jnp.where(counts, log_weight - largest, 0.0)), 0.0)
    return weight / jnp.maximum(jnp.sum(weight), 1.0)


OBJECTIVES: Registry[Objective] = Registry(
    "objective",
    {
        "visitation": Objective(visitation, score_pairs, needs_bound=True),
        "transition": Objective(transition, score_pairs),
        "trajectory": Objective(trajectory, score_trajectories, trajectories=True),
    },
)
"""Maps each name to its objective."""
