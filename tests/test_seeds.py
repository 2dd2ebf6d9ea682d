import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import seeds

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
def test_wide_networks_run_one_seed_at_a_time(count, devices, width):
    assert seeds.group_size(count, devices, (8, width)) == 1


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
