import gc
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.io import checkpoint

# Orbax warns on every load without shardings, which is how `load` without `like` reads.
pytestmark = pytest.mark.filterwarnings("ignore:Sharding info not provided:UserWarning")


class Moments(NamedTuple):
    first: jax.Array
    second: dict


class State(flax.struct.PyTreeNode):
    moments: Moments
    key: jax.Array
    step: jax.Array
    reward: jax.Array | None


def make_state(seed):
    key = jax.random.key(seed)
    return State(
        moments=Moments(
            jax.random.normal(key, (3, 2)), {"layers": [jnp.arange(seed), jnp.zeros((), bool)]}
        ),
        key=jax.random.split(key, 2),
        step=jnp.int32(seed),
        reward=None,
    )


STATE = make_state(7)


def assert_equal(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert x.dtype == y.dtype
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(x, y)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoints") / "state"
    checkpoint.save(path, STATE)
    return path


def test_load_returns_what_was_saved(path):
    assert_equal(checkpoint.load(path, make_state(7)), STATE)


def test_an_abstract_state_is_enough_to_load(path):
    assert_equal(checkpoint.load(path, jax.eval_shape(lambda: STATE)), STATE)


def test_without_a_structure_containers_are_plain(path):
    tree = checkpoint.load(path)
    assert set(tree) == {"moments", "key", "step", "reward"}
    np.testing.assert_array_equal(tree["moments"]["first"], STATE.moments.first)
    np.testing.assert_array_equal(tree["moments"]["second"]["layers"][0], np.arange(7))


def test_a_loaded_key_continues_the_same_stream(path):
    loaded = checkpoint.load(path, STATE)
    np.testing.assert_array_equal(jax.random.normal(loaded.key[1]), jax.random.normal(STATE.key[1]))


def test_saving_replaces_what_is_there(tmp_path):
    checkpoint.save(tmp_path / "state", STATE)
    checkpoint.save(tmp_path / "state", make_state(8))
    assert_equal(checkpoint.load(tmp_path / "state", make_state(8)), make_state(8))
    assert [entry.name for entry in tmp_path.iterdir()] == ["state"]


@pytest.mark.parametrize("like", [None, STATE])
@pytest.mark.parametrize("kind", ["nothing", "file", "folder"])
def test_a_folder_without_a_checkpoint_is_not_found(tmp_path, kind, like):
    path = tmp_path / "here"
    if kind == "file":
        path.write_text("")
    elif kind == "folder":
        path.mkdir()
    with pytest.raises(FileNotFoundError, match="here: no checkpoint"):
        checkpoint.load(path, like)


@pytest.mark.parametrize(
    "like",
    [
        STATE.moments,
        {"step": STATE.step},
        STATE.replace(reward=jnp.zeros(())),
        STATE.replace(step=None),
        STATE.replace(moments=STATE.moments._replace(second=jnp.zeros(3))),
    ],
    ids=["part", "fewer", "more", "none", "deeper"],
)
def test_another_structure_is_refused(path, like):
    with pytest.raises(ValueError, match=str(path)):
        checkpoint.load(path, like)


# When one of orbax's reads fails it abandons the others, which warn when they are collected.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("shape", [(2,), (5,), (3, 1), ()])
def test_another_shape_is_refused(tmp_path, shape):
    checkpoint.save(tmp_path / "leaf", {"leaf": jnp.zeros(3)})
    with pytest.raises(ValueError, match="shape"):
        checkpoint.load(tmp_path / "leaf", {"leaf": jnp.zeros(shape)})
    gc.collect()
