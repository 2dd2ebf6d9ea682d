"""Reading npz files from untrusted sources: no pickle, no memory for data that is not there."""

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

_DEFLATE_RATIO = 1032
"""Deflate never shrinks data by more than this factor."""


def read(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Read the arrays `names` of a file, once the sizes of all of them have been checked.

    Raises:
        ValueError: if an array holds pickled objects, is compressed by a method that numpy does not
            write, or claims more bytes than the file can hold.
        Exception: what zipfile, zlib or numpy raise for a damaged file.
    """
    with zipfile.ZipFile(path) as archive:
        for name in names:
            _check_size(archive, f"{name}.npy", path.stat().st_size)
        return {name: _read_array(archive, f"{name}.npy") for name in names}


def _check_size(archive: zipfile.ZipFile, name: str, length: int) -> None:
    """Refuse an array whose header claims more bytes than a file of `length` bytes can hold."""
    entry = archive.getinfo(name)
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed by another method")
    with archive.open(entry) as file:
        major, _ = np.lib.format.read_magic(file)
        read_header = {
            1: np.lib.format.read_array_header_1_0,
            2: np.lib.format.read_array_header_2_0,
        }[major]
        shape, _, dtype = read_header(file)
        size = file.tell() + math.prod(shape) * dtype.itemsize
    if dtype.hasobject:
        raise ValueError(f"{name} holds pickled objects")
    if size != entry.file_size or size > _DEFLATE_RATIO * min(entry.compress_size, length):
        raise ValueError(f"{name} claims {size} bytes, which are not there")


def _read_array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(name) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
