"""Files and folders that appear on disk whole: a power cut leaves all of one, or nothing."""

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path


def partial(path: Path) -> Path:
    """Where a file or a folder lies until it is whole."""
    return path.with_name(f".{path.name}.partial")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path to write a file or a folder to, which then replaces `path` in one move.

    An error leaves nothing.
    """
    written = partial(path)
    # A process that was killed may have left something there.
    _remove(written)
    try:
        yield written
        replace(written, path)
    finally:
        _remove(written)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)


def replace(written: Path, path: Path) -> None:
    """Flush the file or folder `written` to the disk, and move it to `path`.

    Raises:
        OSError: if it cannot be flushed or moved.
    """
    flush(written)
    os.replace(written, path)
    flush_name(path)


def check_writable(folder: Path) -> None:
    """Check that files can be written in a folder, which may not be there yet; leaves none.

    Raises:
        OSError: if they cannot.
    """
    nearest = next(path for path in (folder, *folder.absolute().parents) if exists(path))
    with tempfile.TemporaryFile(dir=nearest):
        pass


def exists(path: Path) -> bool:
    """Whether there is a file or folder: as `Path.exists`, which hides errors in newer Pythons.

    Raises:
        OSError: if it cannot be told, as for a name that is too long.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def flush(path: Path) -> None:
    """Flush a file, or a folder and everything in it.

    Raises:
        OSError: if something in it cannot be read or flushed.
    """

    def refuse(error: OSError) -> None:
        raise error

    if path.is_dir():
        for folder, _, names in os.walk(path, topdown=False, onerror=refuse):
            for name in names:
                _flush_one(Path(folder, name))
            _flush_one(Path(folder))
    else:
        _flush_one(path)


def flush_name(path: Path) -> None:
    """Flush the name of a file or folder, which is stored in its parent folder."""
    _flush_one(path.parent)


def _flush_one(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some file systems cannot flush folders.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)
