import errno
import os
from pathlib import Path

import numpy as np
import pytest

from cmedirl_jax.data import demonstrations
from cmedirl_jax.io import atomic, checkpoint
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from tests.support import kills, pools


@pytest.fixture
def events(monkeypatch):
    """The flushes and moves in order, each with the path it had at that time."""
    events, fsync, replace = [], os.fsync, os.replace

    def noted_fsync(descriptor):
        events.append(("flush", Path(os.readlink(f"/proc/self/fd/{descriptor}"))))
        fsync(descriptor)

    def noted_replace(source, target):
        events.append(("move", Path(source)))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(os, "replace", noted_replace)
    return events


def assert_safe(events, path, partial):
    """Everything at `path` was flushed before it was moved there, and its folder afterwards."""
    below = [partial / entry.relative_to(path) for entry in path.rglob("*")]
    moved = events.index(("move", partial))
    for entry in (partial, *below):
        assert ("flush", entry) in events[:moved]
    assert ("flush", path.parent) in events[moved:]


needs_proc = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="there is no /proc")


@needs_proc
def test_a_file_and_a_folder_are_flushed_before_they_take_their_names(tmp_path, events):
    (tmp_path / "file.partial").write_text("new")
    (tmp_path / "file").write_text("old")
    atomic.replace(tmp_path / "file.partial", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "new"
    assert_safe(events, tmp_path / "file", tmp_path / "file.partial")
    (tmp_path / "partial" / "deep").mkdir(parents=True)
    (tmp_path / "partial" / "deep" / "file").touch()
    atomic.replace(tmp_path / "partial", tmp_path / "folder")
    assert_safe(events, tmp_path / "folder", tmp_path / "partial")


@needs_proc
def test_demonstrations_are_flushed(tmp_path, events):
    demonstrations.save(tmp_path / "pool.npz", pools.scripted(2))
    assert_safe(events, tmp_path / "pool.npz", tmp_path / ".pool.npz.partial")


@needs_proc
def test_checkpoints_are_flushed(tmp_path, events):
    with Checkpointer(
        tmp_path, {}, every=0.0, interruption=Interruption(), say=pytest.fail
    ) as checkpointer:
        checkpointer.save_if_due(250, lambda: ({"weights": np.zeros(3)}, {"rows": np.arange(2)}))
    assert_safe(events, tmp_path / "250", tmp_path / ".250.partial")


@needs_proc
def test_saved_trees_are_flushed(tmp_path, events):
    checkpoint.save(tmp_path / "tree", {"weights": np.zeros(3)})
    assert_safe(events, tmp_path / "tree", tmp_path / ".tree.partial" / "new")


def contents(folder):
    """Every file in `folder`, with its bytes."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_replacing_moves_the_whole_file_into_place(tmp_path):
    path = tmp_path / "table"
    path.write_text("old")
    with atomic.replacing(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert contents(tmp_path) == {"table": b"new"}


@pytest.mark.parametrize("before", [{}, {"table": b"old"}])
def test_replacing_leaves_things_as_they_were_after_an_error(tmp_path, before):
    for name, content in before.items():
        (tmp_path / name).write_bytes(content)

    def write_half():
        with atomic.replacing(tmp_path / "table") as partial:
            partial.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert contents(tmp_path) == before


def test_a_file_that_is_replaced_is_the_old_or_the_new_one_after_any_kill(tmp_path):
    def write(folder, text):
        with atomic.replacing(folder / "file") as partial:
            partial.write_text(text)

    def read(folder):
        return (folder / "file").read_text()

    kills.check_replaces(write, read, "old", "new", tmp_path)


def test_file_systems_that_cannot_flush_folders_are_supported(tmp_path, monkeypatch):
    def fail(number):
        def fsync(descriptor):
            raise OSError(number, os.strerror(number))

        return fsync

    monkeypatch.setattr(os, "fsync", fail(errno.EINVAL))
    atomic.flush(tmp_path)
    monkeypatch.setattr(os, "fsync", fail(errno.EIO))
    with pytest.raises(OSError, match="Input/output error"):
        atomic.flush(tmp_path)
