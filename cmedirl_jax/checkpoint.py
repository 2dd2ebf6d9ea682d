"""Pytrees on disk, by orbax. The only file of the library that imports it."""

import os
from pathlib import Path
from typing import Any

import jax
from orbax.checkpoint import v1 as orbax


def save(path: str | Path, tree: Any) -> None:
    """Write a pytree of arrays to the folder `path`, replacing what is there; a whole one or none.

    Raises:
        OSError: if the folder cannot be written.
    """
    orbax.save(os.path.abspath(path), tree, overwrite=True)


def load(path: str | Path, like: Any = None) -> Any:
    """Read a pytree that `save` wrote.

    Args:
        path: the folder.
        like: a pytree of the same structure (arrays, or what `jax.eval_shape` gives), whose
            container types, dtypes and shapes the result takes on. Without it NamedTuples and
            dataclasses come back as dicts, tuples as lists.

    Raises:
        FileNotFoundError: if there is no checkpoint at `path`.
        ValueError: if its structure differs from `like`'s.
    """
    path = os.path.abspath(path)
    if not orbax.is_orbax_checkpoint(path):
        raise FileNotFoundError(f"{path}: no checkpoint there")
    if like is None:
        return orbax.load(path)
    abstract = jax.eval_shape(lambda: like) if _concrete(like) else like
    try:
        return orbax.load(path, abstract)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: holds another structure ({error})") from error


def _concrete(tree: Any) -> bool:
    return not any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in jax.tree.leaves(tree))
