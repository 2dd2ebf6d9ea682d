"""Mean and standard deviation of observations, which stand among a network's parameters.

Under the name `STATISTICS`, so that whatever holds the parameters (a checkpoint, a saved policy, a
target network) normalises as the network does, and evaluation leaves them alone. No gradient
reaches them, and no optimiser moves them: `put` writes them, from a sample or from `Running` ones.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax.types import Array

STATISTICS = "observation_statistics"
"""The name of the statistics among a network's parameters."""
FIXED = (STATISTICS, "batch_stats")
"""Names of parameters that no optimiser moves."""
LEAST_STD = 1e-4
"""A deviation up to this share of max(|mean|, 1) is rounding: 1 takes its place."""


class Statistics(NamedTuple):
    """Mean and standard deviation of observations.

    Attributes:
        mean: `[O]`.
        std: `[O]`, positive.
    """

    mean: Array
    std: Array


def put(params: Any, statistics: Statistics) -> Any:
    """Parameters, or a tree of them, with the statistics of every network in it replaced."""

    def replaced(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        if STATISTICS not in _names(path):
            return leaf
        return jnp.asarray(getattr(statistics, path[-1].key), leaf.dtype)

    return jax.tree_util.tree_map_with_path(replaced, params)


def kept(params: Any) -> bool:
    """Whether a network in a tree of parameters keeps statistics."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(params)
    return any(STATISTICS in _names(path) for path, _ in leaves)


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
        return leaf if _names(path).isdisjoint(FIXED) else jnp.zeros_like(leaf)

    return jax.tree_util.tree_map_with_path(kept_still, updates)


def _names(path: tuple[Any, ...]) -> set[Any]:
    """The names of the mappings that lead to a leaf."""
    return {getattr(key, "key", None) for key in path}


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
