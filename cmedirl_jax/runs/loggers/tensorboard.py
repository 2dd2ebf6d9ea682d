"""TensorBoard's event files, `tensorboard/SERIES/`, by TensorBoard's own code alone.

Its `EventFileWriter` is not used: it imports TensorFlow where that is installed, keeps a thread for
each file, and prints a traceback from there when the disk is full.
"""

import os
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cmedirl_jax.runs.loggers.base import Logger, Point


class _Writer:
    """Appends an event for each point; the file is closed in between.

    A kill may cut the last event short, which TensorBoard skips.
    """

    def __init__(self, folder: Path):
        from tensorboard.compat.proto import event_pb2
        from tensorboard.compat.tensorflow_stub.io.gfile import GFile
        from tensorboard.summary.writer.record_writer import RecordWriter

        # The class is made when its module is imported.
        self._event = event_pb2.Event  # pyright: ignore[reportAttributeAccessIssue]
        folder.mkdir(parents=True)
        # A TensorBoard that shows the log of a stopped run takes a new name for its continuation.
        name = f"events.out.tfevents.{time.time():010.0f}.{socket.gethostname()}.{os.getpid()}"
        self._records = RecordWriter(GFile(str(folder / name), "wb"))
        self._append(file_version="brain.Event:2")

    def write(self, points: Sequence[Point]) -> None:
        for step, scalars in points:
            values = [{"tag": name, "simple_value": x} for name, x in scalars.items()]
            self._append(step=step, summary={"value": values})

    def _append(self, **content: Any) -> None:
        event = self._event(wall_time=time.time(), **content)
        self._records.write(event.SerializeToString())

    def close(self) -> None:
        self._records.close()


def _open(folder: Path, series: str, config: Mapping[str, Any]) -> _Writer:
    return _Writer(folder / "tensorboard" / series)


TENSORBOARD = Logger(_open, package="tensorboard")
