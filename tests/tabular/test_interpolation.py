import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.tabular import Grid
from cmedirl_jax.tabular.interpolation import interpolate, points

GRID = Grid((-1.0, 0.0, 2.0), (3.0, 0.5, 10.0), (3, 2, 5))
coordinates = st.tuples(*(st.floats(-20, 20, width=32) for _ in range(3)))


def test_points_run_over_the_box_with_the_last_dimension_fastest():
    grid_points = points(GRID)
    assert grid_points.shape == (GRID.size, 3) == (30, 3)
    assert grid_points.dtype == np.float32
    np.testing.assert_allclose(grid_points[:6, 2], [2, 4, 6, 8, 10, 2])
    np.testing.assert_allclose(grid_points[[0, -1]], [[-1, 0, 2], [3, 0.5, 10]])
    np.testing.assert_allclose(GRID.spacing, [2, 0.5, 2])


@given(coordinates)
def test_weights_reproduce_linear_functions_inside_and_the_border_outside(position):
    index, weight = interpolate(GRID, np.array(position, np.float32))
    assert index.shape == weight.shape == (8,)
    assert (np.asarray(weight) >= 0).all()
    np.testing.assert_allclose(weight.sum(), 1.0, rtol=1e-6)
    expected = np.clip(position, GRID.low, GRID.high)
    np.testing.assert_allclose(
        np.asarray(weight) @ points(GRID)[np.asarray(index)], expected, atol=1e-4
    )


def test_grid_points_interpolate_to_themselves():
    index, weight = interpolate(GRID, points(GRID))
    heaviest = np.asarray(index)[np.arange(30), np.asarray(weight).argmax(axis=1)]
    np.testing.assert_array_equal(heaviest, np.arange(30))
    np.testing.assert_allclose(weight.max(axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("low", "high", "shape", "message"),
    [
        ((0.0,), (1.0, 2.0), (3,), "as many bounds as sizes"),
        ((0.0,), (1.0,), (1,), "two points"),
        ((0.0,), (np.inf,), (3,), "finite bounds"),
        ((1.0,), (0.0,), (3,), "low must be below its high"),
        ((0.0, 0.0), (1.0, 0.0), (3, 3), "low must be below its high"),
        ((0.0,) * 8, (1.0,) * 8, (11,) * 8, r"would be 1\.71e\+9 numbers \(6\.39 GiB"),
    ],
)
def test_impossible_grids_are_refused(low, high, shape, message):
    with pytest.raises(ValueError, match=message):
        Grid(low, high, shape)
