"""Folders that appear whole, with a seal that says what each of their files held.

The seal is `seal.json`: a schema, values of the folder's own, and the SHA-256 of every other file
and of the seal itself. Checkpoints, finished cells and a run's demonstrations are such folders.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cmedirl_jax.io import atomic

SCHEMA = 3
"""The version of a run's files. Runs of schema 1 had a `tables.json`."""
SEAL = "seal.json"
_NOT_AS_WRITTEN = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
"""Errors that mean a missing file; after other errors the file may still be whole."""


class Damaged(Exception):
    """A sealed folder is not as it was written; says which of its files."""


class OtherSchema(Exception):
    """A folder was sealed by a version that writes another schema."""


@contextlib.contextmanager
def sealed(path: Path, content: dict[str, Any]) -> Iterator[Path]:
    """Give a folder to fill, which then becomes `path` in one move; an error leaves nothing.

    Args:
        path: a name that is free. The folder around it is made.
        content: JSON values for the seal.

    Raises:
        OSError: if it cannot be written, or the name is not free.
    """
    unfinished = atomic.partial(path)
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        yield unfinished
        seal = {"schema": SCHEMA, **content, "files": _digests(unfinished)}
        text = json.dumps({**seal, "sha256": _digest(seal)}, indent=2)
        (unfinished / SEAL).write_text(text + "\n")
        atomic.replace(unfinished, path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def read(path: Path) -> dict[str, Any]:
    """Check every file of a sealed folder; returns the content of its seal.

    Raises:
        Damaged: if a file is missing, added or changed.
        OtherSchema: if the seal is whole and has another schema.
        OSError: if the system fails to read a file, which may be whole.
    """
    try:
        seal = _read_seal(path)
        if seal["schema"] != SCHEMA:
            raise OtherSchema(f"has schema {seal['schema']!r}, this version reads {SCHEMA}")
        sealed_files, files = seal["files"], _digests(path)
    except _NOT_AS_WRITTEN as error:
        raise Damaged(f"is damaged ({Path(error.filename or path).name})") from error
    for name in sorted(sealed_files.keys() | files.keys()):
        if sealed_files.get(name) != files.get(name):
            raise Damaged(f"is damaged ({name})")
    return seal


def _read_seal(path: Path) -> dict[str, Any]:
    try:
        seal = json.loads((path / SEAL).read_bytes())
        digest = seal.pop("sha256")
        if digest == _digest(seal) and "schema" in seal:
            return seal
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise Damaged(f"is damaged ({SEAL})") from error
    raise Damaged(f"is damaged ({SEAL})")


def _digests(folder: Path) -> dict[str, str]:
    """The digest of every file below `folder` but the seal."""

    def refuse(error: OSError) -> None:
        raise error

    digests = {}
    # `rglob` passes over folders that cannot be read.
    walk = os.walk(folder, onerror=refuse)
    for path in sorted(Path(parent, name) for parent, _, names in walk for name in names):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and name != SEAL:
            with path.open("rb") as file:
                digests[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return digests


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
