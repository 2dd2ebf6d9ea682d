import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.training import seeds

KEY = jax.random.key(0)

counts = st.integers(1, 1000)
device_counts = st.integers(1, 16)
widths = st.sampled_from([8, 64, 127, 128, 400])


@pytest.mark.parametrize("count", [1, 5, 8])
def test_a_seeds_key_does_not_depend_on_the_count(count):
    keys = seeds.keys(KEY, count)
    assert keys.shape == (count,)
    for index in range(count):
        assert keys[index] == jax.random.fold_in(KEY, index)


@given(count=counts, devices=device_counts, width=widths)
def test_padding_fills_whole_groups_on_every_device(count, devices, width):
    group = seeds.group_size(count, devices, (width, 8))
    padded = seeds.padded(count, group, devices)
    assert group >= 1
    assert padded % (group * devices) == 0
    assert 0 <= padded - count < group * devices


@given(count=counts, devices=device_counts)
def test_groups_fit_the_cache_with_the_least_padding(count, devices):
    group = seeds.group_size(count, devices)
    per_device = -(-count // devices)
    if per_device < 4:
        assert group == per_device
    else:
        least = min(seeds.padded(count, size, devices) for size in range(4, 11))
        assert group in range(4, 11)
        assert seeds.padded(count, group, devices) == least


@given(count=counts, devices=device_counts, width=st.integers(128, 1024))
def test_wide_networks_run_one_or_two_seeds_at_a_time(count, devices, width):
    most = 2 if width < 256 else 1
    assert seeds.group_size(count, devices, (8, width)) == min(most, -(-count // devices))


def walk(state, scale, offset):
    """Something with a key, a matrix and shared arguments."""
    step = scale["factor"] * jax.random.normal(state["key"], (2, 3)) + offset
    return {"key": jax.random.fold_in(state["key"], 1), "position": state["position"] + step}


def states(count):
    return {"key": seeds.keys(KEY, count), "position": jnp.ones((count, 2, 3))}


SHARED = {"factor": jnp.float32(0.5)}, 0.1


def assert_equals_vmap(actual, count):
    expected = jax.vmap(walk, in_axes=(0, None, None))(states(count), *SHARED)
    assert (actual["key"] == expected["key"]).all()
    np.testing.assert_allclose(actual["position"], expected["position"], rtol=1e-6)


@pytest.mark.parametrize("group", [1, 3, 12])
def test_mapping_groups_equals_vmap(group):
    assert_equals_vmap(seeds.map_groups(walk, group)(states(12), *SHARED), 12)


def test_groups_must_be_whole():
    with pytest.raises(ValueError, match="12 seeds are not whole groups of 5"):
        seeds.map_groups(walk, 5)(states(12), *SHARED)


def test_mapping_over_devices_equals_vmap():
    devices = jax.devices()
    count = 6 * len(devices)
    mapped = jax.jit(seeds.map_devices(seeds.map_groups(walk, 3), devices))(states(count), *SHARED)
    assert_equals_vmap(mapped, count)
    assert mapped["position"].sharding.device_set == set(devices)


def stroll(state, scale, offset):
    state = walk(state, scale, offset)
    return state, {"norm": jnp.linalg.norm(state["position"]), "key": state["key"]}


@pytest.mark.parametrize(("group", "groups"), [(1, 5), (3, 0), (3, 2), (12, 1)])
def test_stepping_some_groups_equals_vmap_on_them_and_leaves_the_others(group, groups):
    stepped, outputs = jax.jit(seeds.step_groups(stroll, group))(states(12), groups, *SHARED)
    expected, expected_outputs = jax.vmap(stroll, in_axes=(0, None, None))(states(12), *SHARED)
    first = group * groups
    for tree, inside, outside in (
        (stepped, expected, states(12)),
        (outputs, expected_outputs, jax.tree.map(jnp.zeros_like, expected_outputs)),
    ):
        for name, leaf in tree.items():
            np.testing.assert_allclose(
                *map(numbers, (leaf[:first], inside[name][:first])), rtol=1e-6
            )
            np.testing.assert_array_equal(*map(numbers, (leaf[first:], outside[name][first:])))


def numbers(leaf):
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf


def test_another_number_of_groups_does_not_compile_again():
    stepped = jax.jit(seeds.step_groups(stroll, 3))
    for groups in range(5):
        stepped(states(12), groups, *SHARED)
    assert stepped._cache_size() == 1


def test_stepped_groups_must_be_whole():
    with pytest.raises(ValueError, match="12 seeds are not whole groups of 5"):
        seeds.step_groups(stroll, 5)(states(12), 1, *SHARED)


def test_stepping_over_devices_steps_the_first_groups_of_each():
    devices = jax.devices()
    count = 6 * len(devices)
    mapped = jax.jit(seeds.map_devices(seeds.step_groups(stroll, 3), devices))
    stepped, outputs = mapped(states(count), 1, *SHARED)
    expected = jax.vmap(walk, in_axes=(0, None, None))(states(count), *SHARED)
    moved = np.arange(count) % 6 < 3
    np.testing.assert_allclose(stepped["position"][moved], expected["position"][moved], rtol=1e-6)
    np.testing.assert_array_equal(stepped["position"][~moved], 1.0)
    assert outputs["norm"].sharding.is_equivalent_to(seeds.sharding(devices), 1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: seeds.keys(KEY, -1), "count must be at least 0, got -1"),
        (lambda: seeds.group_size(0), "seeds must be at least 1, got 0"),
        (lambda: seeds.group_size(3, 0), "devices must be at least 1, got 0"),
        (lambda: seeds.padded(-1, 2), "seeds must be at least 0, got -1"),
        (lambda: seeds.padded(3, 0), "group must be at least 1, got 0"),
        (lambda: seeds.padded(3, 1, 0), "devices must be at least 1, got 0"),
        (lambda: seeds.map_groups(walk, 0), "group must be at least 1, got 0"),
        (lambda: seeds.step_groups(stroll, 0), "group must be at least 1, got 0"),
    ],
)
def test_numbers_of_seeds_that_there_are_not_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("position", [jnp.ones((6, 2, 3)), jnp.ones(())])
def test_leaves_of_other_numbers_of_seeds_are_refused(position):
    wrong = states(12) | {"position": position}
    for mapped in (
        lambda: seeds.map_groups(walk, 2)(wrong, *SHARED),
        lambda: seeds.step_groups(stroll, 2)(wrong, 1, *SHARED),
    ):
        with pytest.raises(ValueError, match="expected leaves with one leading axis of seeds, got"):
            mapped()
