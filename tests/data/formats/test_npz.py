import io
import json
import os
import pathlib
import pickle
import zipfile

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.formats import npz as formats
from cmedirl_jax.io import npz
from cmedirl_jax.types import Demonstrations, Transition
from tests.support import damages, pools

SPEC = pools.ENV.spec
POOL = pools.random_pool([3, 1, 4])


def arrays_of(pool):
    return {**pool.transition._asdict(), "truncated": pool.truncated, "episode": pool.episode}


def assert_equal(actual, expected):
    chex.assert_trees_all_equal(arrays_of(actual), arrays_of(expected), strict=True)
    assert actual.metadata == expected.metadata


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("pools") / "pool.npz"


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "pool.npz"
    demonstrations.save(path, POOL)
    return path.read_bytes()


@given(lengths=pools.episode_lengths, seed=st.integers(0, 99), last_unfinished=st.booleans())
def test_load_returns_what_was_saved(path, lengths, seed, last_unfinished):
    pool = pools.random_pool(lengths, seed, last_unfinished)
    demonstrations.save(path, pool)
    assert_equal(demonstrations.load(path, SPEC), pool)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_the_file_holds_no_pickle(path):
    demonstrations.save(path, POOL)
    with np.load(path, allow_pickle=False) as file:
        assert not any(file[name].dtype.hasobject for name in file.files)


@settings(max_examples=200)
@given(damage=damages.damages())
def test_a_damaged_file_is_refused_in_a_line_or_loads_as_a_valid_pool(path, saved, damage):
    path.write_bytes(saved)
    with damages.done_to(path, damage):
        loaded, refusal = damages.attempt(ValueError, demonstrations.load, path, SPEC)
    if refusal is None:
        assert_equal(loaded, POOL)
    else:
        assert refusal.startswith(f"{path}: ")
        assert "\n" not in refusal


@settings(max_examples=100)
@given(data=st.data())
def test_arrays_of_any_kind_are_refused_in_a_line_or_make_a_valid_pool(path, data):
    names = data.draw(st.sets(st.sampled_from(sorted(arrays_of(POOL))), min_size=1))
    shapes = st.sampled_from([(8,), (8, 1), (8, 2), (0,), (), (7,), (8, 0), (2, 4, 1)])
    dtypes = st.sampled_from(["?", "i1", "i4", "u8", "f2", "f4", "f8", "c8", "S3", "U2", "M8[s]"])
    drawn = {name: hnp.arrays(data.draw(dtypes), data.draw(shapes)) for name in names}
    contents = arrays_of(POOL) | {name: data.draw(arrays) for name, arrays in drawn.items()}
    np.savez(path, header=header(), **contents)
    loaded, refusal = damages.attempt(ValueError, demonstrations.load, path, SPEC)
    if refusal is None:
        demonstrations.validate(loaded, SPEC)
        assert all(np.isfinite(jnp.asarray(leaf)).all() for leaf in loaded.transition)
    else:
        assert refusal.startswith(f"{path}: ")
        assert "\n" not in refusal


@given(share=st.floats(0, 1, exclude_max=True))
def test_a_truncated_file_is_refused(path, saved, share):
    path.write_bytes(saved[: int(share * len(saved))])
    with pytest.raises(ValueError, match=path.name):
        demonstrations.load(path)


@given(position=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_is_refused_or_harmless(path, saved, position, bit):
    content = bytearray(saved)
    content[int(position * len(content))] ^= 1 << bit
    path.write_bytes(content)
    try:
        loaded = demonstrations.load(path)
    except ValueError:
        return
    assert_equal(loaded, POOL)


# Offsets into an entry of a zip file's central directory: the version needed to extract it, its
# flags (1: encrypted) and its compression method (12: bzip2, 14: lzma, 99: unknown).
@pytest.mark.parametrize(("offset", "value"), [(6, 255), (8, 1), (10, 12), (10, 14), (10, 99)])
def test_a_damaged_zip_directory_is_refused(path, saved, offset, value):
    content = bytearray(saved)
    content[saved.index(b"PK\x01\x02") + offset] = value
    path.write_bytes(content)
    with pytest.raises(ValueError, match=path.name):
        demonstrations.load(path)


def header(**changes):
    fields = {"format": formats.FORMAT, "version": 1, "metadata": POOL.metadata} | changes
    return np.array(json.dumps(fields))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": header(format="somebody else's")}, "not a demonstrations file"),
        ({"header": header(version=2)}, "format version 2, this library reads 1"),
        ({"header": header(metadata=None)}, "metadata"),
        ({"header": header(metadata={"env": "Pendulum-v1"})}, "environment 'Pendulum-v1'"),
        ({"header": np.array("not json")}, "not a readable"),
        ({"header": np.array("[]")}, "not a demonstrations file"),
        ({"header": np.zeros(3)}, "not a readable"),
        ({"reward": np.full(8, np.nan, np.float32)}, "reward holds values that are not finite"),
        ({"observation": np.full((8, 2), np.inf, np.float32)}, "observation holds values"),
        ({"action": np.full((8, 1), 1.01, np.float32)}, r"action\[0\] is 1\.01"),
        ({"action": np.zeros((8, 2), np.float32)}, "action has 2 dimensions"),
        ({"action": np.zeros((7, 1), np.float32)}, "action has shape"),
        ({"reward": np.zeros((8, 1), np.float32)}, "reward must be"),
        ({"next_observation": np.zeros((8, 3), np.float32)}, "differ in shape"),
        ({"terminated": np.zeros(8, np.float32)}, "terminated has dtype float32, expected bool"),
        ({"reward": np.zeros(8, np.int32)}, "reward has dtype int32, expected floats"),
        ({"reward": np.full(8, 1e300)}, "reward holds values that are not finite"),
        ({"next_observation": np.full((8, 2), -np.inf, np.float32)}, "next_observation holds"),
        ({"action": np.full((8, 1), np.nan, np.float32)}, "action holds values"),
        ({"action": np.full((8, 1), -1.01, np.float32)}, r"action\[0\] is -1\.01"),
        ({"truncated": np.zeros(8, np.int8)}, "truncated has dtype int8"),
        (
            {"episode": np.zeros(8, np.float32)},
            "episode has dtype float32, expected signed integers",
        ),
        ({"episode": np.zeros(8, np.uint8)}, "episode has dtype uint8"),
        ({"episode": np.array([0, 0, 0, 2, 1, 1, 1, 1], np.int32)}, "without gaps"),
        ({"episode": np.array([1, 1, 1, 2, 3, 3, 3, 3], np.int32)}, "without gaps"),
        (
            {"episode": np.array([0, 0, 1, 1, 2, 2, 2, 2], np.int32)},
            "episode but the last must end",
        ),
    ],
)
def test_other_contents_are_refused_by_name(path, changes, message):
    np.savez(path, **({"header": header()} | arrays_of(POOL) | changes))
    with pytest.raises(ValueError, match=rf"pool\.npz: .*{message}"):
        demonstrations.load(path, SPEC)


def test_episodes_whose_count_wraps_around_are_refused(path):
    pool = pools.random_pool([1] * 200)
    np.savez(
        path, **{"header": header()} | arrays_of(pool) | {"episode": pool.episode.astype("i1")}
    )
    with pytest.raises(ValueError, match=r"pool\.npz: episode must count"):
        demonstrations.load(path)


def test_an_empty_pool_is_refused(path):
    empty = {name: array[:0] for name, array in arrays_of(POOL).items()}
    np.savez(path, header=header(), **empty)
    with pytest.raises(ValueError, match=r"pool\.npz: reward must be \[N\] with N > 0"):
        demonstrations.load(path)


@pytest.mark.parametrize("name", ["header", "reward", "episode"])
def test_a_missing_array_is_refused(path, name):
    contents = {"header": header()} | arrays_of(POOL)
    del contents[name]
    np.savez(path, **contents)
    with pytest.raises(ValueError, match=rf"pool\.npz: .*{name}"):
        demonstrations.load(path)


def contents(write, *args, **kwargs):
    file = io.BytesIO()
    write(file, *args, **kwargs)
    return file.getvalue()


def write_zip(file):
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("header", "{}")


@pytest.mark.parametrize(
    "foreign",
    [
        b"",
        b"observation,action\n",
        contents(np.save, np.zeros(3)),
        contents(np.savez, x=np.zeros(3)),
        contents(np.savez, header=np.array([{}], dtype=object)),
        contents(write_zip),
    ],
    ids=["empty", "text", "npy", "npz", "pickle", "zip"],
)
def test_a_foreign_file_is_refused(path, foreign):
    path.write_bytes(foreign)
    with pytest.raises(ValueError, match=path.name):
        demonstrations.load(path)


class Unpickled:
    """Creates the file `mark` when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return pathlib.Path.touch, (self.mark,)


@pytest.mark.parametrize("name", ["header", "reward", "episode"])
def test_a_pickle_is_never_loaded(path, tmp_path, name):
    mark = tmp_path / "mark"
    hostile = np.array([Unpickled(mark)] * 8, dtype=object)
    np.savez(path, allow_pickle=True, **{"header": header()} | arrays_of(POOL) | {name: hostile})
    with pytest.raises(ValueError, match=rf"pool\.npz: .*{name}\.npy holds pickled objects"):
        demonstrations.load(path)
    path.write_bytes(pickle.dumps(Unpickled(mark)))
    with pytest.raises(ValueError, match=r"pool\.npz: not a readable"):
        demonstrations.load(path)
    assert not mark.exists()
    pickle.loads(path.read_bytes())
    assert mark.exists()


def huge(shape, dtype="<f4"):
    """The header of an array far larger than the bytes that follow it."""
    file = io.BytesIO()
    fields = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, fields)
    return file.getvalue() + bytes(32)


@pytest.mark.parametrize(
    "array",
    [
        huge((10**12,)),
        huge((10**9, 2)),
        huge((2**62, 2**62)),
        huge((-8,)),
        huge((), f"<U{2**28}"),
        huge((8,), "<f4")[:-1],
        huge((8,), "<f4") + b"x",
    ],
    ids=["vector", "matrix", "overflow", "negative", "string", "short", "long"],
)
@pytest.mark.parametrize("name", ["header", "reward", "observation"])
def test_an_array_that_claims_more_than_the_file_holds_is_refused_unread(
    path, monkeypatch, name, array
):
    np.savez(path, **{"header": header()} | arrays_of(POOL))
    with zipfile.ZipFile(path) as archive:
        members = {entry: archive.read(entry) for entry in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for entry, content in (members | {f"{name}.npy": array}).items():
            archive.writestr(entry, content)
    monkeypatch.setattr(npz, "_read_array", lambda *_: pytest.fail("it is read"))
    with pytest.raises(ValueError, match=rf"pool\.npz: .*{name}\.npy claims -?\d+ bytes"):
        demonstrations.load(path)


def test_sizes_that_the_archives_directory_exaggerates_too_are_refused_unread(path, monkeypatch):
    contents = {"header": header()} | arrays_of(POOL)
    del contents["reward"]
    np.savez(path, **contents)
    array = huge((10**9 - 30,), "|u1")
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("reward.npy", array)
        entry = archive.getinfo("reward.npy")
        entry.file_size = len(array) - 32 + 10**9 - 30
        entry.compress_size = 10**9
    monkeypatch.setattr(npz, "_read_array", lambda *_: pytest.fail("it is read"))
    # Newer Pythons see themselves that the entry would reach into the next one.
    refusal = r"reward\.npy claims \d+ bytes|Overlapped entries: 'reward\.npy'"
    with pytest.raises(ValueError, match=rf"pool\.npz: .*({refusal})"):
        demonstrations.load(path)


def test_a_highly_compressible_pool_loads(path):
    steps = 2 * 10**6
    zeros = np.zeros(steps, np.float32)
    pool = Demonstrations(
        Transition(zeros[:, None], zeros[:, None], zeros, zeros[:, None], zeros.astype(bool)),
        zeros.astype(bool),
        zeros.astype(np.int32),
        POOL.metadata,
    )
    demonstrations.save(path, pool)
    assert path.stat().st_size < 100_000
    assert demonstrations.load(path).episode.shape == (steps,)


@pytest.mark.parametrize("kind", ["folder", "pipe", "device", "link to a pipe"])
def test_only_regular_files_are_opened(tmp_path, kind):
    path = tmp_path / "pool.npz"
    match kind:
        case "folder":
            path.mkdir()
        case "pipe":
            os.mkfifo(path)
        case "device":
            path = pathlib.Path("/dev/zero")
        case "link to a pipe":
            os.mkfifo(tmp_path / "pipe")
            path.symlink_to(tmp_path / "pipe")
    with pytest.raises(ValueError, match=rf"{path.name}: not a regular file"):
        demonstrations.load(path)


def test_a_long_header_is_refused_in_a_line(path):
    dtype = np.dtype([(f"field{number}", "f4") for number in range(3000)])
    np.savez(path, **{"header": header()} | arrays_of(POOL) | {"reward": np.zeros(8, dtype)})
    with pytest.raises(ValueError, match=r"pool\.npz: not a readable") as error:
        demonstrations.load(path)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_not_found(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.npz"):
        demonstrations.load(tmp_path / "nowhere.npz")


def disk_full(file, **arrays):
    file.write(b"PK")
    raise OSError("no space left on device")


UNENDED = POOL._replace(truncated=np.zeros(8, bool))
UNWRITABLE = POOL._replace(metadata=POOL.metadata | {"expert": object()})


@pytest.mark.parametrize(
    ("pool", "writer", "error"),
    [
        (POOL, disk_full, OSError),
        (UNENDED, np.savez_compressed, ValueError),
        (UNWRITABLE, np.savez_compressed, TypeError),
    ],
    ids=["disk full", "invalid", "metadata"],
)
def test_a_failed_save_leaves_nothing_and_keeps_an_old_file(
    tmp_path, monkeypatch, pool, writer, error
):
    old = tmp_path / "old.npz"
    demonstrations.save(old, POOL)
    monkeypatch.setattr(np, "savez_compressed", writer)
    for name in ("old.npz", "new.npz"):
        with pytest.raises(error):
            demonstrations.save(tmp_path / name, pool)
    assert list(tmp_path.iterdir()) == [old]
    assert_equal(demonstrations.load(old), POOL)


def test_arrays_on_the_device_can_be_saved(path):
    on_device = jax.tree.map(jnp.asarray, POOL._replace(metadata=None))
    demonstrations.save(path, on_device._replace(metadata=POOL.metadata))
    assert_equal(demonstrations.load(path), POOL)


@pytest.mark.parametrize("metadata", [{}, {"env": None}, None, [SPEC.id]])
def test_a_pool_without_its_environments_name_is_not_saved(tmp_path, metadata):
    """`load` would refuse it."""
    with pytest.raises(ValueError, match=r"metadata\['env'\]: expected the env.* name, got"):
        demonstrations.save(tmp_path / "pool.npz", POOL._replace(metadata=metadata))
    assert not list(tmp_path.iterdir())
