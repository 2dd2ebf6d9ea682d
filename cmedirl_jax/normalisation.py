"""How networks normalise observations: by the task's bounds, or by `observation_statistics`.

Bounds that are infinite or senseless (+-3.4e38, +-1e30) say nothing of the observations.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, modes
from cmedirl_jax.observation_statistics import STATISTICS, Statistics
from cmedirl_jax.types import EnvSpec, Params

Normalise = Literal["bounds", "statistics", "none"]

SENSIBLE = 1e6
"""Bounds of a larger magnitude say nothing of the observations."""
CLIP = 10.0
"""Standard deviations at which an observation that is normalised by statistics is clipped."""


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
        first = Statistics(jnp.zeros(size, jnp.float32), jnp.ones(size, jnp.float32))
        return {STATISTICS: first._asdict()}

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
        ValueError: for another kind, or if the specification contradicts itself.
    """
    checks.env_spec(spec)
    if kind not in get_args(Normalise):
        there = ", ".join(get_args(Normalise))
        raise ValueError(f"normalise_observation is one of {there}, got {kind!r}")
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


def units(spec: EnvSpec, params: Params) -> jax.Array:
    """`[O]`, the size of an observation: half its range, else the deviation in `params`, else 1."""
    made = make(spec, "bounds")
    if not made.has_statistics or STATISTICS not in params:
        return jnp.asarray(made.half_width)
    return jnp.where(made.by_statistics, params[STATISTICS]["std"], made.half_width)
