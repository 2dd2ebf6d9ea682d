"""Pools of demonstrations on disk: npz files without pickle."""

import json
import stat
from pathlib import Path
from typing import Any

import numpy as np

from cmedirl_jax.data.validation import validate
from cmedirl_jax.io import atomic, npz
from cmedirl_jax.types import Demonstrations, EnvSpec, Transition

FORMAT = "cmedirl_jax.demonstrations"
"""What the header of a file says it is."""

FORMAT_VERSION = 1
"""The version that `save` writes, and the only one that `load` reads."""


def save(path: str | Path, demonstrations: Demonstrations) -> None:
    """Write a pool as a compressed npz file. If that fails, an older file at `path` is kept.

    Raises:
        ValueError: if the pool is not valid, or its metadata do not name the environment: `load`
            compares that with its `spec`.
        TypeError: if the metadata are not JSON values.
        OSError: if the file cannot be written.
    """
    validate(demonstrations)
    metadata = demonstrations.metadata
    env = metadata.get("env") if isinstance(metadata, dict) else None
    if not isinstance(env, str):
        raise ValueError(f"metadata['env']: expected the environment's name, got {env!r}")
    path = Path(path)
    header = {"format": FORMAT, "version": FORMAT_VERSION, "metadata": metadata}
    with atomic.replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            header=np.array(json.dumps(header, sort_keys=True)),
            truncated=np.asarray(demonstrations.truncated),
            episode=np.asarray(demonstrations.episode),
            **{name: np.asarray(x) for name, x in demonstrations.transition._asdict().items()},
        )


def load(path: str | Path, spec: EnvSpec | None = None) -> Demonstrations:
    """Read and validate a file that `save` wrote, as numpy arrays.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a regular file, or is damaged, of another kind or version, or not
            valid for `spec`.
        TypeError: as `validate`.
    """
    path = Path(path)
    # Reading a pipe could block for ever.
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError(f"{path}: not a regular file")
    header, arrays = _read(path)
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"{path}: not a demonstrations file of this library")
    if header.get("version") != FORMAT_VERSION:
        raise ValueError(
            f"{path}: format version {header.get('version')!r}, this library reads {FORMAT_VERSION}"
        )
    if not isinstance(header.get("metadata"), dict):
        raise ValueError(f"{path}: its metadata is damaged")
    result = Demonstrations(
        Transition(*(arrays[name] for name in Transition._fields)),
        arrays["truncated"],
        arrays["episode"],
        header["metadata"],
    )
    try:
        validate(result, spec)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return result


def _read(path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    try:
        arrays = npz.read(path, ("header", *Transition._fields, "truncated", "episode"))
        return json.loads(str(arrays.pop("header")[()])), arrays
    except Exception as error:
        # A damaged archive raises many types of error in zipfile, zlib, json and numpy.
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: not a readable demonstrations file ({reason})") from error
