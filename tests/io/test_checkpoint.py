import gc
from pathlib import Path
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.io import checkpoint
from tests.support import kills

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


def test_a_numpy_scalar_is_saved_as_an_array(tmp_path):
    tree = {"float": np.float32(1.5), "flag": np.bool_(True)}
    checkpoint.save(tmp_path / "state", tree)
    assert_equal(checkpoint.load(tmp_path / "state", tree), jax.tree.map(np.asarray, tree))


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"a": [1.5]}, r"tree\['a'\]\[0\]: is of type float; expected an array"),
        (3, "tree: is of type int; expected an array"),
        ({"a": "text"}, "is of type str;"),
        ({"a": jax.ShapeDtypeStruct((2,), float)}, "is of type ShapeDtypeStruct;"),
        ({"a": np.array([None])}, r"tree\['a'\]: is of type ndarray and dtype object;"),
        ({"a": np.array(["text"])}, "is of type ndarray and dtype <U4;"),
        ({"a": np.ma.masked_array([1.0], [True])}, "is of type MaskedArray and dtype float64;"),
        ({"a": np.zeros((0, 3))}, r"tree\['a'\]: has shape \(0, 3\);"),
        ({"a": jnp.zeros(0)}, r"tree\['a'\]: has shape \(0,\);"),
        ({}, "tree: has no leaves; expected one array or more"),
        (None, "tree: has no leaves;"),
    ],
)
def test_what_cannot_be_saved_is_refused_and_leaves_what_was_there(path, tree, message):
    with pytest.raises(ValueError, match=message):
        checkpoint.save(path, tree)
    assert_equal(checkpoint.load(path, STATE), STATE)
    assert [entry.name for entry in path.parent.iterdir()] == ["state"]


def test_a_traced_value_is_refused(tmp_path):
    with pytest.raises(ValueError, match="Tracer"):
        jax.eval_shape(lambda x: checkpoint.save(tmp_path / "state", x), 1.0)


@pytest.mark.parametrize("error", [OSError("no room"), RuntimeError("lost"), KeyboardInterrupt()])
def test_a_save_that_fails_leaves_what_was_there(path, monkeypatch, error):
    def half(path, tree):
        Path(path, "array").mkdir(parents=True)
        raise error

    monkeypatch.setattr(checkpoint.orbax, "save", half)
    with pytest.raises(type(error)):
        checkpoint.save(path, make_state(8))
    assert_equal(checkpoint.load(path, STATE), STATE)
    assert [entry.name for entry in path.parent.iterdir()] == ["state"]


def test_a_save_killed_at_any_moment_leaves_the_old_or_the_new_checkpoint(tmp_path, monkeypatch):
    # A stand-in for orbax, whose changes on disk can be counted.
    def save(path, tree):
        Path(path, "deep").mkdir(parents=True)
        Path(path, "_CHECKPOINT_METADATA").write_text("finished")
        Path(path, "deep", "value").write_text(str(tree["a"]))

    monkeypatch.setattr(checkpoint.orbax, "save", save)
    monkeypatch.setattr(
        checkpoint.orbax, "load", lambda path: Path(path, "deep", "value").read_text()
    )

    def write(folder, value):
        checkpoint.save(folder / "state", {"a": np.int32(value)})

    kills.check_replaces(
        write, lambda folder: checkpoint.load(folder / "state"), "1", "2", tmp_path
    )


def test_between_the_moves_of_a_save_the_old_checkpoint_is_loaded(tmp_path):
    checkpoint.save(tmp_path / "state", STATE)
    (tmp_path / ".state.partial").mkdir()
    (tmp_path / "state").rename(tmp_path / ".state.partial" / "old")
    assert_equal(checkpoint.load(tmp_path / "state", STATE), STATE)
    with pytest.raises(ValueError, match="no leaves"):
        checkpoint.save(tmp_path / "state", {})
    assert_equal(checkpoint.load(tmp_path / "state", STATE), STATE)


def test_a_link_to_a_checkpoint_stays_one(tmp_path):
    checkpoint.save(tmp_path / "state", STATE)
    (tmp_path / "link").symlink_to("state")
    checkpoint.save(tmp_path / "link", make_state(8))
    assert (tmp_path / "link").is_symlink()
    for name in ("link", "state"):
        assert_equal(checkpoint.load(tmp_path / name, make_state(8)), make_state(8))


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
