import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.irl import objectives


@given(st.integers(1, 50), st.integers(1, 50), st.booleans())
def test_visitation_difference_is_that_of_two_empirical_distributions(m, n, append):
    on_demonstrations, on_background = map(
        np.asarray, objectives.visitation_difference(m, n, append=append)
    )
    # By counting: pair i is visited once in the batches that hold it.
    visits_demo = np.r_[np.ones(m), np.zeros(n)] / m
    visits_background = np.r_[np.ones(m) * append, np.ones(n)]
    expected = visits_demo - visits_background / visits_background.sum()
    np.testing.assert_allclose(np.r_[on_demonstrations, on_background], expected, atol=1e-6)
