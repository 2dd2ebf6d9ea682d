"""Product grids."""

import numpy as np


def product(*axes: np.ndarray) -> np.ndarray:
    """All combinations of one value from each of `D` axes, `[M, D]`, the last axis fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
