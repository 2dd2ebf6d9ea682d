"""How two samples of states and actions, or of rewards, differ: MMD, sliced Wasserstein, AUC."""

import jax
import jax.numpy as jnp

from cmedirl_jax.types import Array


def maximum_mean_discrepancy(ours: Array, theirs: Array) -> jax.Array:
    """The maximum mean discrepancy of two samples, `[]` (Gretton et al. 2012).

    The root of the unbiased estimate of its square,
    sqrt(max(0, E[k(x, x')] + E[k(y, y')] - 2 E[k(x, y)])) with a Gaussian kernel whose width is the
    median distance of the pooled points.

    Args:
        ours: `[N, D]`, at least two points.
        theirs: `[M, D]`, likewise.
    """
    ours, theirs = jnp.asarray(ours), jnp.asarray(theirs)
    pooled = jnp.concatenate([ours, theirs])
    squared = jnp.sum((pooled[:, None] - pooled[None]) ** 2, axis=-1)
    rows, columns = jnp.triu_indices(len(pooled), 1)
    median = jnp.median(squared[rows, columns])
    kernel = jnp.exp(-squared / (2.0 * jnp.where(median > 0, median, 1.0)))
    n, m = len(ours), len(theirs)
    # The diagonals are 1: no point is compared with itself.
    within_ours = (jnp.sum(kernel[:n, :n]) - n) / (n * (n - 1))
    within_theirs = (jnp.sum(kernel[n:, n:]) - m) / (m * (m - 1))
    squared_distance = within_ours + within_theirs - 2.0 * jnp.mean(kernel[:n, n:])
    return jnp.sqrt(jnp.maximum(squared_distance, 0.0))


def sliced_wasserstein(
    key: jax.Array, ours: Array, theirs: Array, directions: int = 128
) -> jax.Array:
    """The mean 1-Wasserstein distance along random directions, `[]` (Bonneel et al. 2015).

    Args:
        key: randomness, of the directions.
        ours: `[N, D]`.
        theirs: `[M, D]`.
        directions: how many.
    """
    ours, theirs = jnp.asarray(ours), jnp.asarray(theirs)
    drawn = jax.random.normal(key, (directions, ours.shape[-1]), ours.dtype)
    unit = drawn / jnp.linalg.norm(drawn, axis=-1, keepdims=True)
    return jnp.mean(jax.vmap(_wasserstein)(unit @ ours.T, unit @ theirs.T))


def _wasserstein(ours: jax.Array, theirs: jax.Array) -> jax.Array:
    """The 1-Wasserstein distance of samples on a line: the area between their step functions."""
    points = jnp.sort(jnp.concatenate([ours, theirs]))
    shares = [
        jnp.searchsorted(jnp.sort(sample), points[:-1], side="right") / sample.size
        for sample in (ours, theirs)
    ]
    return jnp.sum(jnp.abs(shares[0] - shares[1]) * jnp.diff(points))


def area_under_roc(positive: Array, negative: Array) -> jax.Array:
    """How often a positive scores above a negative, ties counting half, `[]`.

    Args:
        positive: `[N]` scores.
        negative: `[M]` scores.
    """
    positive, ranked = jnp.asarray(positive), jnp.sort(jnp.asarray(negative))
    below = jnp.searchsorted(ranked, positive, side="left")
    up_to = jnp.searchsorted(ranked, positive, side="right")
    return jnp.mean((below + up_to) / 2.0) / ranked.size


def effective_share(log_weights: Array) -> jax.Array:
    """The effective sample size of importance weights as a share of their number, `[]`.

    Args:
        log_weights: `[N]`.
    """
    weights = jax.nn.softmax(jnp.asarray(log_weights))
    return 1.0 / jnp.sum(weights**2) / weights.size
