import errno
import hashlib
import json
import os
from pathlib import Path

import pytest
from hypothesis import given, settings

from cmedirl_jax.runs.storage import sealing
from tests.support import damages


def contents(folder):
    """Every file below `folder`, with its bytes."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def seal(path, **content):
    """A sealed folder with two files, one of them in a folder of its own."""
    with sealing.sealed(path, content) as unfinished:
        (unfinished / "deep").mkdir()
        (unfinished / "deep" / "file").write_bytes(b"some bytes")
        (unfinished / "table").write_bytes(b"others")
    return path


def test_a_sealed_folder_appears_in_one_move_and_says_what_it_holds(tmp_path):
    path = tmp_path / "new" / "cell"
    with sealing.sealed(path, {"step": 3}) as unfinished:
        (unfinished / "file").write_bytes(b"content")
        assert not path.exists()
    assert sealing.read(path)["step"] == 3
    assert [found.name for found in path.parent.iterdir()] == ["cell"]
    digests = json.loads((path / "seal.json").read_text())["files"]
    assert digests == {"file": hashlib.sha256(b"content").hexdigest()}


def test_an_error_leaves_no_folder(tmp_path):
    def fill_half():
        with sealing.sealed(tmp_path / "cell", {}) as unfinished:
            (unfinished / "file").touch()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fill_half()
    assert not any(tmp_path.iterdir())


def test_what_a_killed_process_left_unfinished_is_written_over(tmp_path):
    (tmp_path / ".cell.partial" / "old").mkdir(parents=True)
    seal(tmp_path / "cell")
    assert not (tmp_path / "cell" / "old").exists()


def test_a_sealed_folder_takes_no_other_ones_place(tmp_path):
    seal(tmp_path / "cell", step=1)
    with pytest.raises(OSError, match="not empty"):
        seal(tmp_path / "cell", step=2)
    assert sealing.read(tmp_path / "cell")["step"] == 1


@pytest.mark.parametrize("name", ["table", "deep/file", "seal.json"])
def test_a_missing_file_is_named(tmp_path, name):
    path = seal(tmp_path / "cell")
    (path / name).unlink()
    with pytest.raises(sealing.Damaged, match=rf"^is damaged \({name}\)"):
        sealing.read(path)


def test_a_file_that_was_added_is_named(tmp_path):
    path = seal(tmp_path / "cell")
    (path / "more").touch()
    with pytest.raises(sealing.Damaged, match=r"^is damaged \(more\)"):
        sealing.read(path)


@pytest.mark.parametrize(
    "content", [b"", b"\xff", b"[]", b"{}", b"[" * 100_000, b'{"sha256": ""}', b'{"schema": 3}']
)
def test_a_foreign_seal_is_damaged(tmp_path, content):
    path = seal(tmp_path / "cell")
    (path / "seal.json").write_bytes(content)
    with pytest.raises(sealing.Damaged, match=r"^is damaged \(seal\.json\)"):
        sealing.read(path)


def test_a_whole_seal_of_another_schema_is_told_from_a_damaged_one(tmp_path, monkeypatch):
    monkeypatch.setattr(sealing, "SCHEMA", 2)
    path = seal(tmp_path / "cell")
    monkeypatch.undo()
    with pytest.raises(sealing.OtherSchema, match="has schema 2, this version reads 3"):
        sealing.read(path)


def test_a_file_that_cannot_be_read_for_now_is_not_damaged(tmp_path, monkeypatch):
    path = seal(tmp_path / "cell")

    def fail(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(hashlib, "file_digest", fail)
    with pytest.raises(OSError, match="Input/output error"):
        sealing.read(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sealed folder, which no test changes for the others."""
    return seal(tmp_path_factory.mktemp("sealed") / "cell", step=7)


@pytest.mark.parametrize("name", ["table", "deep/file", "seal.json"])
@settings(max_examples=60)
@given(damage=damages.damages())
def test_a_file_damaged_anywhere_is_found(folder, name, damage):
    path: Path = folder / name
    content = path.read_bytes()
    with damages.done_to(path, damage):
        seal, refusal = damages.attempt(sealing.Damaged, sealing.read, folder)
        same = path.read_bytes() == content
    if refusal is None:
        # A changed blank between the seal's values says the same.
        assert same or name == "seal.json"
        assert seal["step"] == 7
    else:
        assert not same
        assert refusal == f"is damaged ({name})"
