import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.runs.cells.slots import Lanes


@st.composite
def layouts(draw):
    """Lanes, and which of their seeds are active at one time after another."""
    group, devices, blocks = (
        draw(st.integers(1, 5)),
        draw(st.integers(1, 4)),
        draw(st.integers(1, 4)),
    )
    count = group * devices * blocks
    seeds = draw(st.integers(1, count))
    patterns = st.lists(st.booleans(), min_size=seeds, max_size=seeds).map(np.array)
    return Lanes(count, seeds, group, devices), draw(st.lists(patterns, max_size=4))


def fewest_groups(active, lanes):
    per_device = -(-int(active.sum()) // lanes.devices)
    return -(-per_device // lanes.group)


def stepped_seeds(lanes, groups):
    blocks = lanes.seed.reshape(lanes.devices, -1)
    return set(blocks[:, : groups * lanes.group].ravel())


@given(layouts())
def test_all_seeds_begin_in_the_fewest_groups(layout):
    lanes, _ = layout
    everyone = np.ones(lanes.seeds, bool)
    assert lanes.groups(everyone) == fewest_groups(everyone, lanes)
    assert sorted(lanes.seed) == list(range(lanes.seed.size))


@given(layouts())
def test_packing_needs_the_fewest_groups_and_loses_no_seed(layout):
    lanes, patterns = layout
    for active in patterns:
        contents = lanes.seed.copy()
        before = lanes.groups(active)
        move = lanes.pack(active)
        assert lanes.groups(active) == fewest_groups(active, lanes)
        # It moves only what saves a group.
        assert (move is None) == (lanes.groups(active) == before)
        np.testing.assert_array_equal(lanes.seed, contents if move is None else contents[move])
        assert sorted(lanes.seed) == list(range(lanes.seed.size))
        assert set(np.flatnonzero(active)) <= stepped_seeds(lanes, lanes.groups(active))


@given(layouts())
def test_of_seed_is_the_inverse_of_seed(layout):
    lanes, patterns = layout
    for active in patterns:
        lanes.pack(active)
        np.testing.assert_array_equal(lanes.seed[lanes.of_seed], np.arange(lanes.seeds))


@pytest.mark.parametrize(("ended", "groups"), [(0, 5), (10, 5), (20, 4), (80, 1), (99, 1)])
def test_work_shrinks_with_the_seeds(ended, groups):
    lanes = Lanes(100, 100, 10, 2)
    active = np.random.default_rng(0).permutation(100) >= ended
    lanes.pack(active)
    assert lanes.groups(active) == groups
