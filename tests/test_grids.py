import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import grids

axes = st.lists(st.lists(st.floats(-9, 9), min_size=1, max_size=4), min_size=1, max_size=3)


@given(axes)
def test_a_product_grid_is_the_product_of_its_axes_the_last_one_fastest(axes):
    combinations = grids.product(*map(np.array, axes))
    np.testing.assert_array_equal(combinations, list(itertools.product(*axes)))
