import numpy as np

from cmedirl_jax import rounding


def test_what_is_left_of_a_difference_may_differ_by_what_was_subtracted():
    exact, rounded = np.sin([[np.pi]]), np.sin(np.float32([[np.pi]]))
    assert 0.0 < np.abs(exact - rounded) <= rounding.tolerance(exact) < 2e-7


def test_a_number_outside_is_beyond_its_bound_by_more_than_rounding():
    low, high = np.float32([-100.0, -np.inf]), np.float32([100.0, 0.01])
    inside = [[100.00005, -1e30], [-100.00005, 0.0100005]]
    beyond = [[100.0002, -1e30], [-100.0002, 0.010002]]
    assert rounding.outside(np.array(inside), low, high).tolist() == [[False, False]] * 2
    assert rounding.outside(np.array(beyond), low, high).tolist() == [[True, False], [True, True]]


def test_what_is_not_finite_is_outside_whatever_the_bounds():
    unbounded = np.full(3, np.inf)
    values = np.array([np.nan, np.inf, 3.0])
    assert rounding.outside(values, -unbounded, unbounded).tolist() == [True, True, False]
