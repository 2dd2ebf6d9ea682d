"""Pytrees on disk, by orbax. The only file of the library that imports it."""

import contextlib
import errno
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
from orbax.checkpoint import v1 as orbax

from cmedirl_jax.io import atomic

_OVERHEAD = 2**20
"""Bytes that a checkpoint may take in addition to its arrays."""
_MARK = "_CHECKPOINT_METADATA"
"""A file in every finished orbax checkpoint."""


def save(path: str | Path, tree: Any) -> None:
    """Write a pytree of arrays to the folder `path`, completely or not at all.

    Under `jax.distributed` every process has to call it: orbax makes them wait for each other.

    Args:
        path: the folder. A checkpoint that is there is replaced.
        tree: arrays, none of them empty.

    Raises:
        FileExistsError: if something that is not a checkpoint exists at `path`.
        OSError: if the folder cannot be written, or the disk has no room for the arrays.
        ValueError: if the tree has other leaves than that.
    """
    path = os.path.abspath(path)
    if os.path.exists(path) and not _is_checkpoint(path):
        raise FileExistsError(f"{path}: exists and is not a checkpoint")
    parent = os.path.dirname(path)
    os.makedirs(parent, exist_ok=True)
    # Checked first, because orbax leaves partial files behind when the disk is full.
    needed = sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) + _OVERHEAD
    if shutil.disk_usage(parent).free < needed:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)
    with _os_errors(path):
        orbax.save(path, tree, overwrite=True)
    if jax.process_index() == 0:
        atomic.flush(Path(path))
        atomic.flush_name(Path(path))


def load(path: str | Path, like: Any = None) -> Any:
    """Read a pytree that `save` wrote.

    Args:
        path: the folder.
        like: a pytree of the same structure, of arrays or as `jax.eval_shape` gives it. The result
            has its container types, dtypes and shapes. Without it NamedTuples and dataclasses are
            returned as dicts, and tuples as lists.

    Raises:
        FileNotFoundError: if there is no checkpoint at `path`.
        OSError: if the checkpoint cannot be read.
        ValueError: if its structure differs from `like`'s.
    """
    path = os.path.abspath(path)
    if not _is_checkpoint(path):
        raise FileNotFoundError(f"{path}: no checkpoint there")
    with _os_errors(path):
        if like is None:
            return orbax.load(path)
        return _load(path, like)


def _load(path: str, like: Any) -> Any:
    # Orbax does not complain if one tree has None where the other has an array.
    held = len(jax.tree.leaves(orbax.metadata(path).metadata))
    if held != len(jax.tree.leaves(like)):
        raise ValueError(f"{path}: holds {held} arrays, not {len(jax.tree.leaves(like))}")
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    abstract = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device), like
    )
    try:
        return orbax.load(path, abstract)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: holds another structure ({error})") from error


@contextlib.contextmanager
def _os_errors(path: str) -> Iterator[None]:
    """Raise OSError where tensorstore wraps one into a ValueError."""
    try:
        yield
    except ValueError as error:
        number = re.search(r"os_error_code='(\d+)'", str(error))
        if number is None and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        code = errno.ENOSPC if number is None else int(number[1])
        raise OSError(code, os.strerror(code), path) from error


def _is_checkpoint(path: str) -> bool:
    return os.path.isfile(os.path.join(path, _MARK))
