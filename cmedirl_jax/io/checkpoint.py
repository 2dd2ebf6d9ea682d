"""Pytrees on disk, by orbax. The only file of the library that imports it.

Orbax removes an old checkpoint before it writes the new one, and no folder can be renamed over
another. A save therefore goes through a hidden folder beside the checkpoint, `.NAME.partial`: the
new checkpoint is written there as `new`; then the old one moves there as `old`, and `new` takes its
place. A save that is killed between these two moves leaves `old`, which `load` reads and the next
save moves back.
"""

import contextlib
import errno
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import multihost_utils
from orbax.checkpoint import v1 as orbax

from cmedirl_jax.io import atomic

_OVERHEAD = 2**20
"""Bytes that a checkpoint may take in addition to its arrays."""
_MARK = "_CHECKPOINT_METADATA"
"""A file in every finished orbax checkpoint."""


def save(path: str | Path, tree: Any) -> None:
    """Write a pytree of arrays to the folder `path`, completely or not at all.

    A checkpoint that is there is replaced once the new one is whole. If the save fails or its
    process is killed, `load(path)` gives one of the two; the next save removes what was left over.

    Under `jax.distributed` every process has to call it: they wait for each other.

    Args:
        path: the folder.
        tree: arrays or numpy scalars of dtypes that JAX has, none of them empty.

    Raises:
        FileExistsError: if something that is not a checkpoint exists at `path`.
        OSError: if the folder cannot be written, or the disk has no room for the arrays.
        ValueError: if the tree has other leaves than that, or none.
    """
    tree = _arrays(tree)
    path = Path(os.path.realpath(path))
    if path.exists() and not _is_checkpoint(path):
        raise FileExistsError(f"{path}: exists and is not a checkpoint")
    try:
        _write(path, tree)
    finally:
        if jax.process_index() == 0:
            _tidy(path)


def _arrays(tree: Any) -> Any:
    """The tree with numpy's scalars as arrays; refuses leaves that a checkpoint cannot hold."""
    leaves = jax.tree.leaves_with_path(tree)
    if not leaves:
        raise ValueError("tree: has no leaves; expected one array or more")
    for place, leaf in leaves:
        found = _not_an_array(leaf)
        if found is not None:
            raise ValueError(
                f"tree{jax.tree_util.keystr(place)}: {found}; expected an array of a dtype that "
                "JAX has, and not an empty one"
            )
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, np.generic) else x, tree)


def _not_an_array(leaf: Any) -> str | None:
    """What a leaf is, if it is not an array that a checkpoint can hold."""
    kind = type(leaf).__name__
    arrays = (jax.Array, np.ndarray, np.generic)
    if not isinstance(leaf, arrays) or isinstance(leaf, Tracer):
        return f"is of type {kind}"
    try:
        jax.typeof(leaf)
    except (TypeError, ValueError):
        return f"is of type {kind} and dtype {leaf.dtype}"
    return f"has shape {leaf.shape}" if leaf.size == 0 else None


def _write(path: Path, tree: Any) -> None:
    new, first = atomic.partial(path) / "new", jax.process_index() == 0
    path.parent.mkdir(parents=True, exist_ok=True)
    if first:
        _tidy(path)
        new.parent.mkdir()
    # Checked first, because orbax complains on its own when the disk becomes full.
    needed = sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) + _OVERHEAD
    if shutil.disk_usage(path.parent).free < needed:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    with _os_errors(path):
        orbax.save(str(new), tree)
    try:
        if first:
            _replace(new, path)
    finally:
        # A process that returned earlier could still load the old one.
        multihost_utils.sync_global_devices(f"{path} is saved")


def _replace(new: Path, path: Path) -> None:
    atomic.flush(new.parent)
    atomic.flush_name(new.parent)
    # No flush between the two moves: meanwhile nothing is at `path`.
    if path.exists():
        os.replace(path, new.with_name("old"))
    os.replace(new, path)
    atomic.flush_name(path)


def _tidy(path: Path) -> None:
    """Move the old checkpoint back if a save was cut off without it, and remove the rest."""
    found = _found(path)
    if found != path:
        os.replace(found, path)
    shutil.rmtree(atomic.partial(path), ignore_errors=True)


def _found(path: Path) -> Path:
    """Where the checkpoint of this name lies."""
    if path.exists():
        return path
    old = atomic.partial(path) / "old"
    return old if _is_checkpoint(old) else path


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
    path = _found(Path(os.path.realpath(path)))
    if not _is_checkpoint(path):
        raise FileNotFoundError(f"{path}: no checkpoint there")
    with _os_errors(path):
        if like is None:
            return orbax.load(str(path))
        return _load(str(path), like)


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
def _os_errors(path: Path) -> Iterator[None]:
    """Raise OSError where tensorstore wraps one into a ValueError."""
    try:
        yield
    except ValueError as error:
        number = re.search(r"os_error_code='(\d+)'", str(error))
        if number is None and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        code = errno.ENOSPC if number is None else int(number[1])
        raise OSError(code, os.strerror(code), str(path)) from error


def _is_checkpoint(path: Path) -> bool:
    return (path / _MARK).is_file()
