import numpy as np
import pytest

from cmedirl_jax.irl import base
from cmedirl_jax.types import RewardBatch, Transition


def transition(*leading):
    leaves = (*leading, 3), (*leading, 2), leading, (*leading, 3), leading
    return Transition(*map(np.zeros, leaves))._replace(terminated=np.zeros(leading, bool))


def batch(*leading):
    return RewardBatch(transition(*leading), np.ones(leading[0]), np.ones(leading, bool))


kinds = pytest.mark.parametrize(
    ("check", "leading", "axes"), [(base.pairs, (5,), "B"), (base.trajectories, (4, 6), "M, T")]
)


@kinds
def test_a_valid_batch_is_returned_unchanged(check, leading, axes, skewed_spec):
    given = batch(*leading)
    assert check(skewed_spec, given, "background") is given


@kinds
def test_transitions_get_uniform_weights_and_a_full_mask(check, leading, axes, skewed_spec):
    given = transition(*leading)
    filled = check(skewed_spec, given, "background")
    assert filled.transition is given
    np.testing.assert_array_equal(filled.log_density, np.zeros(leading[0]))
    np.testing.assert_array_equal(filled.mask, np.ones(leading, bool))
    assert filled.mask.dtype == bool


@kinds
@pytest.mark.parametrize(
    ("leaf", "called", "size"),
    [
        ("observation", "observations", ", 3"),
        ("action", "actions", ", 2"),
        ("terminated", "terminated", ""),
        ("log_density", "log densities", None),
        ("mask", "mask", ""),
    ],
)
def test_a_wrong_shape_is_refused_naming_the_batch_and_the_leaf(
    check, leading, axes, leaf, called, size, skewed_spec
):
    given = batch(*leading)
    shape = axes.split(",")[0] if size is None else axes + size
    whole = leaf in RewardBatch._fields
    right = getattr(given if whole else given.transition, leaf)
    for wrong in (right[..., None], right[0], right[:-1], np.repeat(right, 2, axis=-1)):
        if leaf == "observation" and wrong.shape == right[:-1].shape:
            continue  # That is a batch of another size, whose other leaves are then wrong.
        changed = (
            given._replace(**{leaf: wrong})
            if whole
            else given._replace(transition=given.transition._replace(**{leaf: wrong}))
        )
        with pytest.raises(ValueError, match=rf"background: expected {called} \[{shape}\]") as info:
            check(skewed_spec, changed, "background")
        assert str(wrong.shape) in str(info.value)


def test_pairs_are_refused_as_trajectories(skewed_spec):
    with pytest.raises(ValueError, match=r"demonstrations: expected observations \[B, 3\]"):
        base.pairs(skewed_spec, batch(4, 6), "demonstrations")
    with pytest.raises(ValueError, match=r"demonstrations: expected observations \[M, T, 3\]"):
        base.trajectories(skewed_spec, transition(4), "demonstrations")
    with pytest.raises(ValueError, match=r"demonstrations: expected observations \[B, 3\]"):
        base.pairs(skewed_spec, Transition(*np.zeros(5)), "demonstrations")
