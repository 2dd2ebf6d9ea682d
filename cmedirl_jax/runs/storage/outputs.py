"""Files that a command writes when its work is done."""

import errno
import io
import os
from pathlib import Path

import polars as pl

from cmedirl_jax.io import atomic
from cmedirl_jax.runs.errors import UserError


def check(option: str, path: Path | None) -> None:
    """Refuse before the work a file that could not be written after it; None is no file.

    Raises:
        UserError: naming the option.
    """
    if path is None:
        return
    try:
        if atomic.exists(path) and path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        atomic.check_writable(path.parent)
    except OSError as error:
        raise UserError(f"--{option}: cannot write to {path} ({error.strerror})") from error


def write(path: Path, content: bytes) -> None:
    """Write a file in one move, in a folder that is made if it is missing; an equal one stays.

    Raises:
        OSError: if it cannot be written; then nothing is.
    """
    if path.is_file() and path.read_bytes() == content:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(path) as partial:
        partial.write_bytes(content)


def write_table(path: Path, table: pl.DataFrame) -> None:
    """Write a table as Parquet, as `write` does.

    Raises:
        OSError: if it cannot be written; then nothing is.
    """
    buffer = io.BytesIO()
    table.write_parquet(buffer)
    write(path, buffer.getvalue())
