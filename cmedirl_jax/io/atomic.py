"""Names on disk that a power cut finds with all of their content, or not at all."""

import errno
import os
from pathlib import Path


def replace(partial: Path, path: Path) -> None:
    """Flush the file or folder `partial` to the disk and move it to `path`, for good.

    Raises:
        OSError: if either cannot be done.
    """
    flush(partial)
    os.replace(partial, path)
    flush_name(path)


def flush(path: Path) -> None:
    """Flush a file, or a folder with all that is below it."""

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
    """Flush the name of a file or folder, which is what the folder around it holds."""
    _flush_one(path.parent)


def _flush_one(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some file systems flush no folders.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)
