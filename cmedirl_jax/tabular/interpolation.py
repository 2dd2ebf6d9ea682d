"""Regular grids over a box, with multilinear interpolation between their points."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, grids, modes
from cmedirl_jax.types import Array


@dataclasses.dataclass(frozen=True)
class Grid:
    """Evenly spaced points of a box, its bounds included. Static and hashable.

    Raises ValueError for bounds and shapes that do not fit each other, and for more points than
    `checks.LARGEST_ARRAY` allows.

    Attributes:
        low: lower bound of each of the `D` dimensions.
        high: upper bounds.
        shape: points along each dimension, at least two.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    shape: tuple[int, ...]

    def __post_init__(self):
        if not len(self.low) == len(self.high) == len(self.shape):
            raise ValueError(
                f"a grid needs as many bounds as sizes, got {self.low}, {self.high}, {self.shape}"
            )
        if min(self.shape, default=0) < 2:
            raise ValueError(f"a grid needs two points along each dimension, got {self.shape}")
        checks.sizes(**{f"shape[{axis}]": points for axis, points in enumerate(self.shape)})
        if not np.isfinite([*self.low, *self.high]).all():
            raise ValueError(f"a grid needs finite bounds, got {self.low} and {self.high}")
        if not np.all(np.less(self.low, self.high)):
            raise ValueError(f"a grid's low must be below its high, got {self.low} and {self.high}")
        checks.array_size(
            "a grid's points",
            (*self.shape, len(self.shape)),
            "take fewer along each dimension",
        )

    @property
    def size(self) -> int:
        """The number of points."""
        return math.prod(self.shape)

    @property
    def spacing(self) -> np.ndarray:
        """The distance between neighbours along each dimension, `[D]`."""
        return (np.array(self.high) - self.low) / (np.array(self.shape) - 1)


def points(grid: Grid) -> np.ndarray:
    """All points, `[size, D]` float32, the last dimension fastest."""
    bounds = zip(grid.low, grid.high, grid.shape, strict=True)
    return grids.product(*(np.linspace(*axis, dtype=np.float32) for axis in bounds))


def interpolate(grid: Grid, position: Array) -> tuple[jax.Array, jax.Array]:
    """Neighbouring points and their weights. Positions outside the box are moved to its border.

    Args:
        grid: a grid of `D` dimensions.
        position: `[..., D]`.

    Returns:
        Indices into `points(grid)` `[..., 2^D]` int32, and weights that sum to one.
    """
    position, low, spacing, last = modes.align(
        jnp.asarray(position),
        np.array(grid.low, np.float32),
        grid.spacing.astype(np.float32),
        np.array(grid.shape, np.int32) - 1,
    )
    steps = jnp.clip((position - low) / spacing, 0.0, last.astype(jnp.float32))
    below = jnp.minimum(steps.astype(jnp.int32), last - 1)
    corners = grids.product(*[np.arange(2, dtype=np.int32)] * len(grid.shape))  # [2^D, D]
    below, fraction, corners = modes.align(
        below[..., None, :], (steps - below)[..., None, :], corners
    )
    index = jnp.ravel_multi_index(
        tuple(jnp.moveaxis(below + corners, -1, 0)), grid.shape, mode="clip"
    )
    weight = jnp.where(corners, fraction, 1.0 - fraction)
    return index.astype(jnp.int32), jnp.prod(weight, axis=-1)
