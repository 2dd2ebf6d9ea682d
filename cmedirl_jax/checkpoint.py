"""Pytrees on disk, by orbax. The only file of the library that imports it."""

import os
from pathlib import Path
from typing import Any

import jax
from orbax.checkpoint import v1 as orbax

_MARK = "_CHECKPOINT_METADATA"
"""A file that every finished orbax checkpoint has."""


def save(path: str | Path, tree: Any) -> None:
    """Write a pytree of arrays to the folder `path`; a whole one or none.

    Raises:
        FileExistsError: if there is something at `path` that is not a checkpoint, to be replaced.
        OSError: if the folder cannot be written.
    """
    path = os.path.abspath(path)
    if os.path.exists(path) and not _is_checkpoint(path):
        raise FileExistsError(f"{path}: exists and is not a checkpoint")
    orbax.save(path, tree, overwrite=True)


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
