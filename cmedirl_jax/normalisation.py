"""How networks normalise observations: by the task's bounds, or by statistics of observations.

Bounds that are infinite or senseless (+-3.4e38, +-1e30) say nothing of the observations. There the
mean and standard deviation of observations stand among a network's parameters, under the name
`STATISTICS`. So whatever holds the parameters (a checkpoint, a saved policy, a target network)
normalises as the network does, and evaluation leaves the statistics alone. No gradient reaches
them: `put` writes them, from demonstrations or from `Running` ones.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, modes
from cmedirl_jax.types import Array, EnvSpec, Params

Normalise = Literal["bounds", "statistics", "none"]

STATISTICS = "observation_statistics"
"""The name of the statistics among a network's parameters."""
FIXED = (STATISTICS, "batch_stats")
"""Names of parameters that no optimiser moves."""
SENSIBLE = 1e6
"""Bounds of a larger magnitude say nothing of the observations."""
CLIP = 10.0
"""Standard deviations at which an observation that is normalised by statistics is clipped."""
LEAST_STD = 1e-4
"""Of constant observations, as a share of their magnitude or of 1."""


class Statistics(NamedTuple):
    """Of observations.

    Attributes:
        mean: `[O]`.
        std: `[O]`, positive.
    """

    mean: Array
    std: Array


class Normaliser(NamedTuple):
    """An affine map of observations, for one network.

    Attributes:
        centre: `[O]`, used where the bounds are.
        half_width: `[O]`, likewise.
        by_statistics: `[O]` bool, where the network's statistics are used instead.
    """

    centre: np.ndarray
    half_width: np.ndarray
    by_statistics: np.ndarray

    @property
    def has_statistics(self) -> bool:
        """Whether the network keeps statistics among its parameters."""
        return bool(self.by_statistics.any())

    def initial(self) -> Params:
        """What is added to a network's first parameters."""
        if not self.has_statistics:
            return {}
        size = self.centre.shape
        return {STATISTICS: Statistics(jnp.zeros(size), jnp.ones(size))._asdict()}

    def __call__(self, variables: Params, observation: jax.Array) -> jax.Array:
        """Normalise `[..., O]` by the bounds, and by the statistics among `variables`."""
        checks.vectors("observation", observation, len(self.centre))
        if not self.has_statistics:
            aligned, centre, half_width = modes.align(observation, self.centre, self.half_width)
            return (aligned - centre) / half_width
        kept = jax.lax.stop_gradient(variables[STATISTICS])
        centre = jnp.where(self.by_statistics, kept["mean"], self.centre)
        half_width = jnp.where(self.by_statistics, kept["std"], self.half_width)
        aligned, centre, half_width = modes.align(observation, centre, half_width)
        scaled = (aligned - centre) / half_width
        return jnp.where(self.by_statistics, jnp.clip(scaled, -CLIP, CLIP), scaled)


def sensible(spec: EnvSpec) -> Any:
    """`[O]` bool, whether both bounds of an observation say where it lies."""
    bounds = np.stack([spec.observation_low, spec.observation_high]).astype(np.float64)
    return np.all(np.abs(bounds) <= SENSIBLE, axis=0)


def make(spec: EnvSpec, kind: Normalise) -> Normaliser:
    """The normaliser of a task.

    Args:
        spec: the task's bounds.
        kind: "bounds" where they are sensible, and statistics elsewhere; "statistics" everywhere;
            "none".

    Raises:
        ValueError: if the specification contradicts itself.
    """
    checks.env_spec(spec)
    low, high, known = spec.observation_low, spec.observation_high, sensible(spec)
    size = spec.observation_dim
    if kind == "none":
        return Normaliser(
            np.zeros(size, np.float32), np.ones(size, np.float32), np.zeros(size, bool)
        )
    low, high = np.where(known, low, -1.0), np.where(known, high, 1.0)
    by_statistics = ~known if kind == "bounds" else np.ones(size, bool)
    return Normaliser(
        (0.5 * (high + low)).astype(np.float32),
        (0.5 * (high - low)).astype(np.float32),
        by_statistics,
    )


def by_bounds(spec: EnvSpec) -> Callable[[jax.Array], jax.Array]:
    """The affine map from the observation bounds to [-1, 1]: `[..., O]` -> `[..., O]`.

    The map raises ValueError for another last axis, and TypeError for arrays that are not floats.

    Raises:
        ValueError: if the specification contradicts itself, or a bound is infinite or senseless.
    """
    made = make(spec, "bounds")
    if made.has_statistics:
        raise ValueError(
            f"{spec.id}: this needs finite bounds of the observations, got "
            f"{spec.observation_low} and {spec.observation_high}"
        )
    return lambda observation: made({}, observation)


def put(params: Any, statistics: Statistics) -> Any:
    """Parameters, or a tree of them, with the statistics of every network in it replaced."""

    def replaced(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        names = [getattr(key, "key", None) for key in path]
        if STATISTICS not in names:
            return leaf
        return jnp.asarray(getattr(statistics, str(names[-1])), leaf.dtype)

    return jax.tree_util.tree_map_with_path(replaced, params)


def kept(params: Any) -> bool:
    """Whether a network in a tree of parameters keeps statistics."""
    return any(
        STATISTICS in [getattr(key, "key", None) for key in path]
        for path, _ in jax.tree_util.tree_flatten_with_path(params)[0]
    )


def trained(params: Any) -> Any:
    """The parameters that optimisers move, of networks in a tree."""
    if isinstance(params, Mapping):
        return {name: trained(part) for name, part in params.items() if name not in FIXED}
    if isinstance(params, tuple):
        return tuple(trained(part) for part in params)
    return params


def fixed(updates: Any) -> Any:
    """An optimiser's updates without those of `FIXED` parameters, which weight decay would move."""

    def kept_still(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        names = [getattr(key, "key", None) for key in path]
        return jnp.zeros_like(leaf) if any(name in FIXED for name in names) else leaf

    return jax.tree_util.tree_map_with_path(kept_still, updates)


def of_sample(observation: Array) -> Statistics:
    """The statistics of observations `[N, O]`."""
    mean = jnp.mean(observation, axis=0)
    return Statistics(mean, _positive(mean, jnp.std(observation, axis=0)))


class Running(flax.struct.PyTreeNode):
    """Statistics of the observations so far, by Welford's algorithm.

    Attributes:
        count: `[]` float32.
        mean: `[O]`.
        squares: `[O]`, the sum of the squared differences to the mean.
    """

    count: jax.Array
    mean: jax.Array
    squares: jax.Array


def begin(observation: jax.Array) -> Running:
    """Running statistics of one observation `[O]`."""
    first = jnp.asarray(observation, jnp.float32)
    return Running(jnp.ones((), jnp.float32), first, jnp.zeros_like(first))


def add(running: Running, observation: jax.Array) -> Running:
    """Add an observation `[O]`."""
    count = running.count + 1.0
    before = observation - running.mean
    mean = running.mean + before / count
    return Running(count, mean, running.squares + before * (observation - mean))


def of_running(running: Running) -> Statistics:
    """The statistics so far; a standard deviation of 1 before the second observation."""
    std = jnp.sqrt(running.squares / running.count)
    std = jnp.where(running.count > 1.0, _positive(running.mean, std), 1.0)
    return Statistics(running.mean, std)


def _positive(mean: jax.Array, std: jax.Array) -> jax.Array:
    # A constant observation has only rounding error to divide by.
    return jnp.where(std > LEAST_STD * jnp.maximum(jnp.abs(mean), 1.0), std, 1.0)
