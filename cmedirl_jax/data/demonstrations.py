"""Demonstrations: a pool of trajectories, and each learner's subset of it.

    pool = demonstrations.load("pool.npz", env.spec)
    subset = demonstrations.subset(key, pool, n=10)
    batch = demonstrations.sample(key, pool, subset, batch_size=32)

A pool holds whole episodes, one after the other. A `DemonstrationSubset` says where `n` of them
start and how long they are. A hundred learners with different demonstrations thus share one array,
and nothing is ragged.
"""

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, ranges
from cmedirl_jax.data.completion import clip, complete
from cmedirl_jax.data.formats import FORMATS, load, parse, read, save
from cmedirl_jax.data.formats.minari import FACTS, from_minari, to_minari
from cmedirl_jax.data.trajectories import from_trajectories
from cmedirl_jax.data.validation import absent, can_be_repeated, check, validate
from cmedirl_jax.types import Demonstrations, DemonstrationSubset, Numeric, Transition

__all__ = [
    "FORMATS",
    "DemonstrationSubset",
    "Demonstrations",
    "absent",
    "at",
    "can_be_repeated",
    "check",
    "clip",
    "complete",
    "discounted_returns",
    "episodes",
    "from_minari",
    "from_trajectories",
    "keep",
    "load",
    "parse",
    "read",
    "returns",
    "sample",
    "sample_episodes",
    "sample_index",
    "save",
    "subset",
    "to_minari",
    "validate",
]


def episodes(demonstrations: Demonstrations) -> DemonstrationSubset:
    """All episodes of the pool, as numpy arrays (on the host)."""
    episode = np.asarray(demonstrations.episode)
    start = np.flatnonzero(np.r_[True, episode[1:] != episode[:-1]])
    return DemonstrationSubset(
        start.astype(np.int32), np.diff(np.r_[start, episode.size]).astype(np.int32)
    )


def returns(demonstrations: Demonstrations) -> np.ndarray:
    """The undiscounted return of each episode of the pool, `[E]`."""
    start = episodes(demonstrations).start
    return np.add.reduceat(np.asarray(demonstrations.transition.reward, np.float64), start)


def keep(demonstrations: Demonstrations, kept: np.ndarray) -> Demonstrations:
    """Some episodes of a pool, on the host.

    Args:
        demonstrations: the pool.
        kept: `[E]` bool, which episodes stay, at least one. Of the metadata stay the task, who
            made it and its reference scores, and the seeds of these episodes.

    Raises:
        ValueError: if none stays, or for another shape.
        TypeError: for another dtype.
    """
    length = episodes(demonstrations).length
    checks.shape("kept", kept, length.shape)
    checks.kind("kept", kept, np.bool_)
    if not np.any(kept):
        raise ValueError(f"none of the {len(kept)} episodes stays")
    rows = np.repeat(kept, length)
    transition, truncated = jax.tree.map(
        lambda leaf: np.asarray(leaf)[rows], (demonstrations.transition, demonstrations.truncated)
    )
    number = np.arange(np.sum(kept), dtype=np.int32)
    known = demonstrations.metadata
    # A description tells of all the episodes.
    names = {"env", *FACTS} - {"description"}
    metadata = {name: value for name, value in known.items() if name in names}
    if isinstance(seeds := known.get("seeds"), list) and len(seeds) == len(kept):
        metadata["seeds"] = [seed for seed, stays in zip(seeds, kept, strict=True) if stays]
    return Demonstrations(transition, truncated, np.repeat(number, length[kept]), metadata)


def subset(
    key: jax.Array,
    pool: Demonstrations | DemonstrationSubset,
    n: Numeric,
    size: int | None = None,
) -> DemonstrationSubset:
    """Draw `n` different episodes of a pool, uniformly.

    Args:
        key: randomness.
        pool: the pool; under jit, its `episodes`.
        n: how many; may be traced if `size` is given.
        size: length of the result; the entries after the first `n` are padding. Default `n`.

    Raises:
        ValueError: if the pool holds fewer than `n` (or `size`) episodes, `n` is not a scalar or,
            where it is no array of JAX's, not between 1 and `size`, or `size` is not positive.
        TypeError: if `n` or `size` is not an integer.
    """
    checks.shape("n", n, ())
    checks.kind("n", n, jnp.integer)
    if isinstance(pool, Demonstrations):
        pool = episodes(pool)
    size = size if size is not None else int(n)
    if isinstance(n, int | np.integer) and not 1 <= n <= size:
        raise ValueError(f"n must be between 1 and {size}, got {n}")
    checks.sizes(size=size)
    if size > pool.start.shape[0]:
        raise ValueError(f"{size} demonstrations asked, the pool holds {pool.start.shape[0]}")
    # The head of a permutation: the first n do not depend on the padding.
    chosen = jax.random.permutation(key, pool.start.shape[0])[:size]
    length = jnp.where(jnp.arange(size) < n, jnp.asarray(pool.length)[chosen], 0)
    return DemonstrationSubset(jnp.asarray(pool.start)[chosen], length)


def sample_index(key: jax.Array, subset: DemonstrationSubset, batch_size: int) -> jax.Array:
    """Draw steps of the pool, `[batch_size]` int32, uniformly over the subset's episodes' steps.

    Raises:
        ValueError: as `check_subset`, or if `batch_size` is negative.
        TypeError: if the subset or `batch_size` is not of integers.
    """
    check_subset(subset)
    checks.counts(batch_size=batch_size)
    subset = jax.tree.map(jnp.asarray, subset)
    ends = jnp.cumsum(subset.length)
    step = jax.random.randint(key, (batch_size,), 0, ends[-1], jnp.int32)
    which = jnp.searchsorted(ends, step, side="right")
    offset = step - (ends[which] - subset.length[which])
    return subset.start[which] + offset


def sample(
    key: jax.Array,
    pool: Demonstrations | Transition,
    subset: DemonstrationSubset,
    batch_size: int,
) -> Transition:
    """Draw a minibatch `[batch_size, ...]` of a subset's steps, uniformly with replacement.

    Args:
        key: randomness.
        pool: the pool; under jit, its transitions, leaves `[N, ...]`.
        subset: the episodes to draw from.
        batch_size: how many steps.

    Raises:
        ValueError: as `check_subset`, or if `batch_size` is negative.
        TypeError: if the subset or `batch_size` is not of integers.
    """
    transition = pool.transition if isinstance(pool, Demonstrations) else pool
    check_subset(subset, len(transition.reward))
    return at(transition, sample_index(key, subset, batch_size))


def sample_episodes(key: jax.Array, subset: DemonstrationSubset, count: int) -> jax.Array:
    """Draw episodes of the subset, `[count]` int32, uniformly with replacement; never its padding.

    Raises:
        ValueError: as `check_subset`, or if `count` is negative.
        TypeError: if the subset or `count` is not of integers.
    """
    check_subset(subset)
    checks.counts(count=count)
    return jax.random.randint(key, (count,), 0, jnp.sum(jnp.asarray(subset.length) > 0), jnp.int32)


def check_subset(subset: DemonstrationSubset, steps: int | None = None) -> None:
    """Check a subset, of a pool of so many steps if they are given.

    Raises:
        ValueError: if its fields are not `[n]`; if known entries are negative, all lengths are 0,
            or an episode reaches beyond the pool.
        TypeError: if a field is not of integers.
    """
    for name, leaf in subset._asdict().items():
        checks.shape(f"subset.{name}", leaf, (jnp.size(subset.start),))
        checks.kind(f"subset.{name}", leaf, jnp.integer)
        checks.within(ranges.COUNT, **{f"subset.{name}": leaf})
    if not all(map(ranges.known, subset)):
        return
    start, length = map(np.asarray, subset)
    if not length.any():
        raise ValueError(f"subset.length: expected a positive one, got {length}")
    if steps is not None and (end := np.max((start + length)[length > 0])) > steps:
        raise ValueError(f"subset: an episode ends at step {end}, the pool has {steps} steps")


def at(pool: Transition, index: jax.Array) -> Transition:
    """The steps `index` `[...]` of a pool's transitions, leaves `[..., ...]`.

    Raises:
        ValueError: if a known index is negative or beyond the pool.
        TypeError: if the indices are not integers.
    """
    checks.indices(len(pool.reward), index=index)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], pool)


def discounted_returns(demonstrations: Demonstrations, discount: float) -> np.ndarray:
    """G_t = r_t + discount G_{t+1} within each episode, `[N]` float32 (on the host).

    Raises:
        ValueError: if the discount is not between 0 and 1.
    """
    checks.shares(discount=discount)
    result = np.array(demonstrations.transition.reward, np.float64)
    start, length = episodes(demonstrations)
    # All episodes at once, from their last steps backwards.
    for t in range(int(length.max()) - 2, -1, -1):
        at = start[length > t + 1] + t
        result[at] += discount * result[at + 1]
    return result.astype(np.float32)
