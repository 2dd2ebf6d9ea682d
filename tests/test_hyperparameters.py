import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import hyperparameters


def test_traced_hyperparameters_are_float32():
    made = [
        hyperparameters.traced({"rate": value, "none": None}) for value in (1, 1.0, np.float64(1.0))
    ]
    assert len({str(jax.tree.map(jnp.asarray, tree)) for tree in made}) == 1
    assert made[0]["rate"].dtype == jnp.float32
