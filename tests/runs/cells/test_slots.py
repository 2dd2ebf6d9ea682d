import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.runs.cells.slots import Slots


@st.composite
def layouts(draw):
    """Slots, and which of their seeds are active at one time after another."""
    group, devices, blocks = (
        draw(st.integers(1, 5)),
        draw(st.integers(1, 4)),
        draw(st.integers(1, 4)),
    )
    count = group * devices * blocks
    seeds = draw(st.integers(1, count))
    patterns = st.lists(st.booleans(), min_size=seeds, max_size=seeds).map(np.array)
    return Slots(count, seeds, group, devices), draw(st.lists(patterns, max_size=4))


def fewest_groups(active, slots):
    per_device = -(-int(active.sum()) // slots.devices)
    return -(-per_device // slots.group)


def stepped_seeds(slots, groups):
    blocks = slots.seed.reshape(slots.devices, -1)
    return set(blocks[:, : groups * slots.group].ravel())


@given(layouts())
def test_all_seeds_begin_in_the_fewest_groups(layout):
    slots, _ = layout
    everyone = np.ones(slots.seeds, bool)
    assert slots.groups(everyone) == fewest_groups(everyone, slots)
    assert sorted(slots.seed) == list(range(slots.seed.size))


@given(layouts())
def test_packing_needs_the_fewest_groups_and_loses_no_seed(layout):
    slots, patterns = layout
    for active in patterns:
        contents = slots.seed.copy()
        before = slots.groups(active)
        move = slots.pack(active)
        assert slots.groups(active) == fewest_groups(active, slots)
        # It moves only what saves a group.
        assert (move is None) == (slots.groups(active) == before)
        np.testing.assert_array_equal(slots.seed, contents if move is None else contents[move])
        assert sorted(slots.seed) == list(range(slots.seed.size))
        assert set(np.flatnonzero(active)) <= stepped_seeds(slots, slots.groups(active))


@given(layouts())
def test_of_seed_is_the_inverse_of_seed(layout):
    slots, patterns = layout
    for active in patterns:
        slots.pack(active)
        np.testing.assert_array_equal(slots.seed[slots.of_seed], np.arange(slots.seeds))


@pytest.mark.parametrize(("ended", "groups"), [(0, 5), (10, 5), (20, 4), (80, 1), (99, 1)])
def test_work_shrinks_with_the_seeds(ended, groups):
    slots = Slots(100, 100, 10, 2)
    active = np.random.default_rng(0).permutation(100) >= ended
    slots.pack(active)
    assert slots.groups(active) == groups
