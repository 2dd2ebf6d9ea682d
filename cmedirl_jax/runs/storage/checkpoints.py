"""A cell's training on disk: saved as it goes, the last two kept, the newest whole one loaded.

A checkpoint is a folder, `checkpoints/CELL/STEP`, that appears in one move when it is complete:

    state/          the device's arrays, by orbax
    record.npz      the host's arrays
    manifest.json   what wrote it, and the digest of every file

A checkpoint whose files are not those of its manifest is never read further, and removed. One
that the system fails to read may be whole: it is kept.
"""

import concurrent.futures
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from cmedirl_jax.io import atomic, checkpoint
from cmedirl_jax.runs.cluster import exchange, orbax_worker
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import UserError

SCHEMA = 2
KEPT = 2
_PARTIAL = ".partial"
_DAMAGED = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
"""What the system says of files that are not as they were written; else it could not read them."""


class Snapshot(NamedTuple):
    """All that a cell's training goes on from, on the host.

    Attributes:
        step: how far it is.
        state: a pytree of numpy arrays, none of them empty.
        record: further arrays by name.
    """

    step: int
    state: Any
    record: dict[str, np.ndarray]


class Checkpointer:
    """Keeps one cell's training while it runs.

    Saving goes on in the background, one checkpoint at a time; leaving the context waits for it. A
    checkpoint that cannot be written is reported and done without: those before it stay.
    """

    def __init__(
        self,
        folder: Path,
        identity: dict[str, Any],
        *,
        every: float,
        interruption: Interruption,
        say: Callable[[str], None],
    ):
        """Keep a cell in `folder`, which need not be there yet.

        Args:
            folder: `checkpoints/CELL`.
            identity: JSON values that must be equal for a checkpoint to be gone on from.
            every: seconds from one checkpoint to the next.
            interruption: obeyed once what was reached is saved.
            say: called with a line for the user.
        """
        self.folder, self.identity, self.every = folder, identity, every
        self._interruption, self._say = interruption, say
        self._saving = concurrent.futures.ThreadPoolExecutor(max_workers=1)
        self._pending: concurrent.futures.Future[None] | None = None
        self._due = time.monotonic() + every

    def __enter__(self) -> "Checkpointer":
        return self

    def __exit__(self, *_: object) -> None:
        self.wait()
        self._saving.shutdown()

    def load(self, like: Callable[[dict[str, np.ndarray]], Any]) -> Snapshot | None:
        """The newest checkpoint that is whole; those that are not are reported and removed.

        Args:
            like: the abstract state (as `jax.eval_shape` gives it) that belongs to a record.

        Raises:
            UserError: if one has another schema or identity, or the system does not let it be read;
                it is left as it is.
        """
        held: list[Snapshot] = []

        def read() -> dict[str, Any] | None:
            found = self._newest(like)
            if found is None:
                return None
            held.append(found)
            return {"step": found.step, "names": list(found.record)}

        found = exchange.from_writer(read)
        if found is None:
            return None
        step, names = found["step"], found["names"]
        self._say(f"{self.folder.name} goes on from its checkpoint at step {step:,}")
        mine = [*held[0].record.values(), *jax.tree.leaves(held[0].state)] if held else None
        arrays = exchange.arrays_from_writer(mine)
        record = dict(zip(names, arrays, strict=False))
        state = jax.tree.unflatten(jax.tree.structure(like(record)), arrays[len(names) :])
        return Snapshot(step, state, record)

    def _newest(self, like: Callable[[dict[str, np.ndarray]], Any]) -> Snapshot | None:
        try:
            for path in _newest_first(self.folder):
                try:
                    return _read(path, self.identity, like)
                except _Unusable as error:
                    reason = str(error)
                except _DAMAGED as error:
                    reason = f"is damaged ({Path(error.filename or path).name})"
                self._say(f"{path} {reason}: going back to the one before, if there is one")
                shutil.rmtree(path)
        except OSError as error:
            raise UserError(
                f"--out: cannot use {error.filename or self.folder} "
                f"({error.strerror or error}); the checkpoints are kept"
            ) from error
        return None

    def save_if_due(self, step: int, take: Callable[[], tuple[Any, dict[str, np.ndarray]]]) -> None:
        """Save if it is time or a signal came.

        Args:
            step: how far the training is.
            take: gives the state and the record to save, which nobody writes over after.

        Raises:
            Interrupted: if a signal came, after saving.
        """
        stops = self._interruption.came()
        if not stops and not exchange.any_process(time.monotonic() >= self._due):
            return
        self.wait()
        snapshot = Snapshot(step, *take())
        if exchange.is_writer():
            self._pending = self._saving.submit(_write, self.folder, self.identity, snapshot)
        self._due = time.monotonic() + self.every
        if stops:
            self.wait()
            self._interruption.stop()

    def wait(self) -> None:
        """Wait until the last checkpoint is on disk."""
        if self._pending is None:
            return
        pending, self._pending = self._pending, None
        try:
            pending.result()
        except OSError as error:
            self._say(f"no checkpoint could be saved in {self.folder} ({error.strerror or error})")

    def remove(self) -> None:
        """Remove every checkpoint: the cell is finished."""
        self.wait()
        shutil.rmtree(self.folder, ignore_errors=True)


class _Unusable(Exception):
    """Why a checkpoint cannot be gone on from."""


def _newest_first(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        # Whatever else is called like a step is not ours.
        steps = [
            folder / entry.name
            for entry in entries
            if entry.name.isdecimal() and entry.is_dir(follow_symlinks=False)
        ]
    return sorted(steps, key=lambda path: int(path.name), reverse=True)


def _write(folder: Path, identity: dict[str, Any], snapshot: Snapshot) -> None:
    partial = folder / _PARTIAL
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        orbax_worker.call(checkpoint.save, partial / "state", snapshot.state)
        with (partial / "record.npz").open("wb") as file:
            np.savez(file, allow_pickle=False, **snapshot.record)
        manifest = {
            "schema": SCHEMA,
            "step": snapshot.step,
            "identity": identity,
            "files": _digests(partial),
        }
        sealed = {**manifest, "sha256": _digest_of(manifest)}
        (partial / "manifest.json").write_text(json.dumps(sealed, indent=2) + "\n")
        atomic.replace(partial, folder / str(snapshot.step))
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    for old in _newest_first(folder)[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)


def _read(
    path: Path, identity: dict[str, Any], like: Callable[[dict[str, np.ndarray]], Any]
) -> Snapshot:
    try:
        manifest = json.loads((path / "manifest.json").read_bytes())
        digest = manifest.pop("sha256")
        intact = digest == _digest_of(manifest)
        schema = manifest["schema"]
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise _Unusable("is damaged (manifest.json)") from error
    if not intact:
        raise _Unusable("is damaged (manifest.json)")
    if schema != SCHEMA:
        raise UserError(
            f"--out: {path} has schema {schema!r}, this version reads {SCHEMA}; go on with the "
            "version that wrote it, or remove it"
        )
    step, written, files = (manifest[name] for name in ("step", "identity", "files"))
    if step != int(path.name):
        raise _Unusable(f"is damaged (it is of step {step})")
    found = _digests(path)
    for name in sorted(files.keys() | found.keys()):
        if files.get(name) != found.get(name):
            raise _Unusable(f"is damaged ({name})")
    for name in sorted(written.keys() | identity.keys()):
        if written.get(name) != identity.get(name):
            raise UserError(
                f"--out: {path} was written with {name} {written.get(name)}, this is "
                f"{identity.get(name)}; go on with that, or remove it to train the cell anew"
            )
    with np.load(path / "record.npz", allow_pickle=False) as archive:
        record = dict(archive)
    try:
        state = orbax_worker.call(checkpoint.load, path / "state", like(record))
    except ValueError as error:
        raise _Unusable("holds another structure") from error
    return Snapshot(step, jax.tree.map(np.asarray, state), record)


def _digests(folder: Path) -> dict[str, str]:
    """The digest of every file below `folder` but the manifest."""

    def refuse(error: OSError) -> None:
        raise error

    digests = {}
    # `rglob` passes over folders that cannot be read.
    walk = os.walk(folder, onerror=refuse)
    for path in sorted(Path(parent, name) for parent, _, names in walk for name in names):
        if path.is_file() and path.name != "manifest.json":
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            digests[path.relative_to(folder).as_posix()] = digest
    return digests


def _digest_of(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
