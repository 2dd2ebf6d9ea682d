"""Demonstrations: one pool of trajectories, subsets of it that vmap, and a file format.

A pool holds whole episodes one after the other. A learner's own demonstrations are a
`DemonstrationSubset`: where `n` of the pool's episodes start and how long they are. So a hundred
learners with different demonstrations share one array, and nothing is ragged.
"""

import json
import stat
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks
from cmedirl_jax.io import atomic, npz
from cmedirl_jax.types import Array, EnvSpec, Numeric, Transition

FORMAT = "cmedirl_jax.demonstrations"
FORMAT_VERSION = 1


class Demonstrations(NamedTuple):
    """A pool of `N` demonstrated steps, episode after episode.

    Attributes:
        transition: leaves `[N, ...]`, the environment's own rewards among them.
        truncated: `[N]` bool, the episode was cut off by the time limit here.
        episode: `[N]` int32, which episode the step belongs to: 0, 0, ..., 1, 1, ...
        metadata: a dict for the host (JSON values): at least `env`, the environment's name. Pass
            `pool.transition` and a subset to jitted functions, not the pool.
    """

    transition: Transition
    truncated: Array
    episode: Array
    metadata: dict[str, Any]


class DemonstrationSubset(NamedTuple):
    """`n` episodes of a pool: `start` `[n]` and `length` `[n]`, both int32. Length 0 is padding."""

    start: Array
    length: Array


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
        size: length of the result, of which all but the first `n` are padding. Default `n`.

    Raises:
        ValueError: if the pool holds fewer than `n` (or `size`) episodes, or `n` is no scalar or
            not positive.
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
    # A permutation's head: the first n are the same whatever the padding.
    chosen = jax.random.permutation(key, pool.start.shape[0])[:size]
    length = jnp.where(jnp.arange(size) < n, jnp.asarray(pool.length)[chosen], 0)
    return DemonstrationSubset(jnp.asarray(pool.start)[chosen], length)


def sample_index(key: jax.Array, subset: DemonstrationSubset, batch_size: int) -> jax.Array:
    """Steps of the pool, `[batch_size]` int32, uniform over all steps of the subset's episodes.

    Raises:
        ValueError: if the subset's fields are not `[n]`, or `batch_size` is negative.
        TypeError: if the subset or `batch_size` is not of integers.
    """
    _check_subset(subset)
    checks.counts(batch_size=batch_size)
    subset = jax.tree.map(jnp.asarray, subset)
    ends = jnp.cumsum(subset.length)
    step = jax.random.randint(key, (batch_size,), 0, ends[-1])
    which = jnp.searchsorted(ends, step, side="right")
    offset = step - (ends[which] - subset.length[which])
    return subset.start[which] + offset


def sample(
    key: jax.Array,
    pool: Demonstrations | Transition,
    subset: DemonstrationSubset,
    batch_size: int,
) -> Transition:
    """A minibatch `[batch_size, ...]` of a subset's steps, uniform with replacement.

    Args:
        key: randomness.
        pool: the pool; under jit, its transitions, leaves `[N, ...]`.
        subset: which episodes of it.
        batch_size: how many steps.

    Raises:
        ValueError: if the subset's fields are not `[n]`, or `batch_size` is negative.
        TypeError: if the subset or `batch_size` is not of integers.
    """
    transition = pool.transition if isinstance(pool, Demonstrations) else pool
    return at(transition, sample_index(key, subset, batch_size))


def sample_episodes(key: jax.Array, subset: DemonstrationSubset, count: int) -> jax.Array:
    """Episodes of the subset, `[count]` int32, uniform with replacement; never its padding.

    Raises:
        ValueError: if the subset's fields are not `[n]`, or `count` is negative.
        TypeError: if the subset or `count` is not of integers.
    """
    _check_subset(subset)
    checks.counts(count=count)
    return jax.random.randint(key, (count,), 0, jnp.sum(jnp.asarray(subset.length) > 0))


def _check_subset(subset: DemonstrationSubset) -> None:
    for name, leaf in subset._asdict().items():
        checks.shape(f"subset.{name}", leaf, (jnp.size(subset.start),))
        checks.kind(f"subset.{name}", leaf, jnp.integer)


def at(pool: Transition, index: jax.Array) -> Transition:
    """The steps `index` `[...]` of a pool's transitions, leaves `[..., ...]`."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], pool)


def discounted_returns(demonstrations: Demonstrations, discount: float) -> np.ndarray:
    """G_t = r_t + discount G_{t+1} within each episode, `[N]` float32 (on the host).

    Raises:
        ValueError: if the discount is not between 0 and 1.
    """
    checks.shares(discount=discount)
    reward = np.asarray(demonstrations.transition.reward, np.float64)
    episode = np.asarray(demonstrations.episode)
    result = np.empty_like(reward)
    following = 0.0
    for t in range(reward.size - 1, -1, -1):
        if t + 1 < reward.size and episode[t + 1] != episode[t]:
            following = 0.0
        following = result[t] = reward[t] + discount * following
    return result.astype(np.float32)


def validate(demonstrations: Demonstrations, spec: EnvSpec | None = None) -> None:
    """Check a pool, against an environment if `spec` is given.

    Raises:
        ValueError: naming the first thing found wrong: another environment, shapes, dtypes, no
            steps, values that are not finite, actions out of bounds, episodes out of order.
    """
    transition, truncated, episode, metadata = demonstrations
    if spec is not None and metadata.get("env") != spec.id:
        raise ValueError(f"made for environment {metadata.get('env')!r}, not {spec.id!r}")
    arrays = {**transition._asdict(), "truncated": truncated, "episode": episode}
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    size = arrays["reward"].shape
    if len(size) != 1 or size[0] == 0:
        raise ValueError(f"reward must be [N] with N > 0, got shape {size}")
    for name, array in arrays.items():
        vector = name in ("observation", "next_observation", "action")
        if array.shape[:1] != size or array.ndim != (2 if vector else 1):
            raise ValueError(f"{name} has shape {array.shape}, reward has {size}")
        kinds = {"terminated": "b", "truncated": "b", "episode": "i"}
        if array.dtype.kind != kinds.get(name, "f"):
            raise ValueError(f"{name} has dtype {array.dtype}")
        if not (np.abs(array) <= np.finfo(np.float32).max).all():
            raise ValueError(f"{name} holds values that are not finite")
    if arrays["observation"].shape != arrays["next_observation"].shape:
        raise ValueError("observation and next_observation differ in shape")
    if spec is not None:
        _validate_sizes(arrays, spec)
    change = np.diff(arrays["episode"].astype(np.int64))
    if arrays["episode"][0] != 0 or not np.isin(change, (0, 1)).all():
        raise ValueError("episode must count 0, 0, ..., 1, 1, ... without gaps")
    ended = arrays["terminated"] | arrays["truncated"]
    if not np.array_equal(ended[:-1], change == 1):
        raise ValueError("each episode but the last must end, and only there, at its last step")


def _validate_sizes(arrays: dict[str, np.ndarray], spec: EnvSpec) -> None:
    for name, dim in (("observation", spec.observation_dim), ("action", spec.action_dim)):
        if arrays[name].shape[1] != dim:
            raise ValueError(f"{name} has {arrays[name].shape[1]} dimensions, {spec.id} has {dim}")
    tolerance = 1e-6 * (spec.action_high - spec.action_low)
    below = arrays["action"] < spec.action_low - tolerance
    if (below | (arrays["action"] > spec.action_high + tolerance)).any():
        raise ValueError(f"action leaves the bounds {spec.action_low} to {spec.action_high}")


def save(path: str | Path, demonstrations: Demonstrations) -> None:
    """Write a pool as a compressed npz file (no pickle); a whole file or none.

    Raises:
        ValueError: if the pool is not valid.
        OSError: if the file cannot be written.
    """
    validate(demonstrations)
    path = Path(path)
    header = {"format": FORMAT, "version": FORMAT_VERSION, "metadata": demonstrations.metadata}
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                header=np.array(json.dumps(header, sort_keys=True)),
                truncated=np.asarray(demonstrations.truncated),
                episode=np.asarray(demonstrations.episode),
                **{name: np.asarray(x) for name, x in demonstrations.transition._asdict().items()},
            )
        atomic.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def load(path: str | Path, spec: EnvSpec | None = None) -> Demonstrations:
    """Read and validate a file that `save` wrote, as numpy arrays.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no regular file, damaged, foreign, of a newer version, or not valid for
            `spec`.
    """
    path = Path(path)
    # A pipe might never end, or never begin.
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError(f"{path}: not a regular file")
    header, arrays = _read(path)
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"{path}: not a demonstrations file of this library")
    if header.get("version") != FORMAT_VERSION:
        raise ValueError(
            f"{path}: format version {header.get('version')!r}, this library reads {FORMAT_VERSION}"
        )
    if not isinstance(header.get("metadata"), dict):
        raise ValueError(f"{path}: its metadata is damaged")
    result = Demonstrations(
        Transition(*(arrays[name] for name in Transition._fields)),
        arrays["truncated"],
        arrays["episode"],
        header["metadata"],
    )
    try:
        validate(result, spec)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return result


def _read(path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    try:
        arrays = npz.read(path, ("header", *Transition._fields, "truncated", "episode"))
        return json.loads(str(arrays.pop("header")[()])), arrays
    except Exception as error:
        # A damaged archive raises whatever zipfile, zlib, json or numpy happen to stumble over.
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: not a readable demonstrations file ({reason})") from error
