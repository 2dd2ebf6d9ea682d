"""Pytrees on disk, by orbax. The only file of the library that imports it."""

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import jax
from orbax.checkpoint import v1 as orbax

_OVERHEAD = 2**20
"""Bytes that a checkpoint may take beside its arrays."""
_MARK = "_CHECKPOINT_METADATA"
"""A file that every finished orbax checkpoint has."""


def save(path: str | Path, tree: Any) -> None:
    """Write a pytree of arrays to the folder `path`; a whole one or none.

    Under `jax.distributed`, orbax's way: every process calls it, and all wait for each other.

    Args:
        path: the folder; a checkpoint that is there is replaced.
        tree: arrays, none of them empty.

    Raises:
        FileExistsError: if there is something at `path` that is not a checkpoint, to be replaced.
        OSError: if the folder cannot be written, or its disk has no room for the arrays.
    """
    path = os.path.abspath(path)
    if os.path.exists(path) and not _is_checkpoint(path):
        raise FileExistsError(f"{path}: exists and is not a checkpoint")
    parent = os.path.dirname(path)
    os.makedirs(parent, exist_ok=True)
    # Before orbax begins: where it runs out of room it leaves its traces and its complaints.
    needed = sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) + _OVERHEAD
    if shutil.disk_usage(parent).free < needed:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)
    try:
        orbax.save(path, tree, overwrite=True)
    except ValueError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path) from error


def load(path: str | Path, like: Any = None) -> Any:
    """Read a pytree that `save` wrote.

    Args:
        path: the folder.
        like: a pytree of the same structure (of arrays, or as `jax.eval_shape` gives it), whose
            container types, dtypes and shapes the result takes on. Without it NamedTuples and
            dataclasses come back as dicts, tuples as lists.

    Raises:
        FileNotFoundError: if there is no checkpoint at `path`.
        ValueError: if its structure differs from `like`'s.
    """
    path = os.path.abspath(path)
    if not _is_checkpoint(path):
        raise FileNotFoundError(f"{path}: no checkpoint there")
    if like is None:
        return orbax.load(path)
    # Orbax passes over a None that stands where the other tree has an array.
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


def _is_checkpoint(path: str) -> bool:
    return os.path.isfile(os.path.join(path, _MARK))
