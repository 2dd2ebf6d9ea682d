"""A cell's training on disk: saved as it goes, the last two kept, the newest whole one loaded.

A checkpoint is a sealed folder, `checkpoints/CELL/STEP`:

    state/        the device's arrays, by orbax
    record.npz    the host's arrays
    seal.json     the step, what it may be continued by, the digest of every file

A damaged checkpoint is removed unread. One that the system fails to read may be whole: it is kept.
"""

import concurrent.futures
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from cmedirl_jax.io import atomic, checkpoint
from cmedirl_jax.runs.cluster.base import ALONE, Cluster
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import sealing

FOLDER = "checkpoints"
KEPT = 2


class Snapshot(NamedTuple):
    """All that a cell's training continues from, on the host.

    Attributes:
        step: how many steps were taken.
        state: a pytree of numpy arrays, none of them empty.
        record: further arrays by name.
    """

    step: int
    state: Any
    record: dict[str, np.ndarray]


class Checkpointer:
    """Saves one cell's training while it runs.

    Checkpoints are written in the background, one at a time; leaving the context waits for the
    last. If one cannot be written, a line says so and training continues; those before it stay.
    """

    def __init__(
        self,
        folder: Path,
        identity: dict[str, Any],
        *,
        every: float,
        interruption: Interruption,
        say: Callable[[str], None],
        cluster: Cluster = ALONE,
    ):
        """Save a cell in `folder`, which is made when needed.

        Args:
            folder: `checkpoints/CELL`.
            identity: JSON values that must be equal for a checkpoint to be continued.
            every: seconds from one checkpoint to the next.
            interruption: obeyed once the training has been saved.
            say: called with a line for the user.
            cluster: the processes of the run.
        """
        self.folder, self.identity, self.every = folder, identity, every
        self._interruption, self._say, self._cluster = interruption, say, cluster
        self._saving = concurrent.futures.ThreadPoolExecutor(max_workers=1)
        self._pending: concurrent.futures.Future[None] | None = None
        self._due = time.monotonic() + every

    def __enter__(self) -> "Checkpointer":
        return self

    def __exit__(self, *_: object) -> None:
        self.wait()
        self._saving.shutdown()

    def load(self, like: Callable[[dict[str, np.ndarray]], Any]) -> Snapshot | None:
        """The newest checkpoint that is whole; damaged ones are reported and removed.

        Args:
            like: the abstract state (as `jax.eval_shape` gives it) that belongs to a record.

        Raises:
            UserError: if one has another schema or identity, or cannot be read for now; it stays.
        """
        mine: list[Snapshot] = []

        def read() -> dict[str, Any] | None:
            newest = self._newest(like)
            if newest is None:
                return None
            mine.append(newest)
            return {"step": newest.step, "names": list(newest.record)}

        newest = self._cluster.from_writer(read)
        if newest is None:
            return None
        step, names = newest["step"], newest["names"]
        self._say(f"{self.folder.name} goes on from its checkpoint at step {step:,}")
        # Process 0 has read the arrays and sends them to the others.
        sent = [*mine[0].record.values(), *jax.tree.leaves(mine[0].state)] if mine else None
        arrays = self._cluster.arrays_from_writer(sent)
        record = dict(zip(names, arrays, strict=False))
        state = jax.tree.unflatten(jax.tree.structure(like(record)), arrays[len(names) :])
        return Snapshot(step, state, record)

    def _newest(self, like: Callable[[dict[str, np.ndarray]], Any]) -> Snapshot | None:
        try:
            for path in _newest_first(self.folder):
                try:
                    return self._read(path, like)
                except (sealing.Damaged, _OtherStructure) as error:
                    self._say(f"{path} {error}: going back to the one before, if there is one")
                shutil.rmtree(path)
        except OSError as error:
            raise UserError(
                f"--out: cannot use {error.filename or self.folder} "
                f"({error.strerror or error}); the checkpoints are kept"
            ) from error
        return None

    def _read(self, path: Path, like: Callable[[dict[str, np.ndarray]], Any]) -> Snapshot:
        try:
            seal = sealing.read(path)
        except sealing.OtherSchema as error:
            raise UserError(
                f"--out: {path} {error}; continue with the version that wrote it, or remove it"
            ) from error
        if seal["step"] != int(path.name):
            raise sealing.Damaged(f"is damaged (it is of step {seal['step']})")
        written = seal["identity"]
        for name in sorted(written.keys() | self.identity.keys()):
            if written.get(name) != self.identity.get(name):
                raise UserError(
                    f"--out: {path} was written with {name} {written.get(name)}, this is "
                    f"{self.identity.get(name)}; go on with that, or remove it to train the cell "
                    "anew"
                )
        with np.load(path / "record.npz", allow_pickle=False) as archive:
            record = dict(archive)
        try:
            state = self._cluster.call(checkpoint.load, path / "state", like(record))
        except ValueError as error:
            raise _OtherStructure("holds another structure") from error
        return Snapshot(seal["step"], jax.tree.map(np.asarray, state), record)

    def save_if_due(self, step: int, take: Callable[[], tuple[Any, dict[str, np.ndarray]]]) -> None:
        """Save if it is time or a signal came.

        Args:
            step: how many steps were taken.
            take: gives the state and the record to save, which nobody changes afterwards.

        Raises:
            Interrupted: if a signal came, after saving.
        """
        stops = self._interruption.came()
        if not stops and not self._cluster.any(time.monotonic() >= self._due):
            return
        self.wait()
        snapshot = Snapshot(step, *take())
        if self._cluster.writer:
            self._pending = self._saving.submit(self._write, snapshot)
        self._due = time.monotonic() + self.every
        if stops:
            self.wait()
            self._interruption.stop()

    def _write(self, snapshot: Snapshot) -> None:
        # A process that was killed may have left a checkpoint of another step unfinished.
        for unfinished in self.folder.glob(atomic.partial(self.folder / "*").name):
            shutil.rmtree(unfinished, ignore_errors=True)
        content = {"step": snapshot.step, "identity": self.identity}
        with sealing.sealed(self.folder / str(snapshot.step), content) as unfinished:
            self._cluster.call(checkpoint.save, unfinished / "state", snapshot.state)
            with (unfinished / "record.npz").open("wb") as file:
                np.savez(file, allow_pickle=False, **snapshot.record)
        for old in _newest_first(self.folder)[KEPT:]:
            shutil.rmtree(old, ignore_errors=True)

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


class _OtherStructure(Exception):
    """A checkpoint is whole, and of other arrays than the training has."""


def _newest_first(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        # A file or a link may have such a name by chance; it is not the run's.
        steps = [
            folder / entry.name
            for entry in entries
            if entry.name.isdecimal() and entry.is_dir(follow_symlinks=False)
        ]
    return sorted(steps, key=lambda path: int(path.name), reverse=True)
