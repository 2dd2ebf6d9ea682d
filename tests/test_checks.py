import jax.numpy as jnp
import pytest

from cmedirl_jax import checks
from cmedirl_jax.types import Transition


def transition(spec, *leading):
    vector = jnp.zeros((*leading, spec.observation_dim))
    scalar = jnp.zeros(leading)
    return Transition(
        vector, jnp.zeros((*leading, spec.action_dim)), scalar, vector, scalar.astype(bool)
    )


@pytest.mark.parametrize("leading", [(), (4,), (3, 5)])
def test_leaves_of_the_specs_sizes_pass(skewed_spec, leading):
    checks.transition_shapes(skewed_spec, transition(skewed_spec, *leading), leading, "batch")


@pytest.mark.parametrize("field", Transition._fields)
def test_any_leaf_of_another_shape_is_refused_with_both_shapes(skewed_spec, field):
    wrong = transition(skewed_spec, 4)._replace(**{field: jnp.zeros((4, 7))})
    with pytest.raises(ValueError, match=rf"batch: expected .*got .*'{field}': \(4, 7\)"):
        checks.transition_shapes(skewed_spec, wrong, (4,), "batch")


def test_other_leading_axes_are_refused(skewed_spec):
    with pytest.raises(ValueError, match="batch: expected"):
        checks.transition_shapes(skewed_spec, transition(skewed_spec, 4), (5,), "batch")
