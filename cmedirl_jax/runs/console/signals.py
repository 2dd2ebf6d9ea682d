"""SIGINT and SIGTERM: noted at once, obeyed where the run can be continued later."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

from cmedirl_jax.runs.cluster.base import ALONE, Cluster
from cmedirl_jax.runs.errors import Interrupted

SIGNALS = (signal.SIGINT, signal.SIGTERM)
TWICE = 1.0
"""Seconds within which a second signal counts as the first: some schedulers send it twice."""


class Interruption:
    """Which signal has asked this process to stop, if any."""

    def __init__(self, cluster: Cluster = ALONE, restore: Callable[[], None] = lambda: None):
        self.signal: int | None = None
        self._cluster, self._restore = cluster, restore

    def came(self) -> bool:
        """Whether a signal has asked any process of the run to stop."""
        return self._cluster.any(self.signal is not None)

    def stop(self) -> NoReturn:
        """Stop here.

        Raises:
            Interrupted: by this process's signal; SIGTERM, if it was another's.
        """
        raise Interrupted(signal.SIGTERM if self.signal is None else self.signal)

    def release(self) -> None:
        """Let signals act at once from here on: there is nothing left to save.

        Raises:
            Interrupted: if one came before.
        """
        self._restore()
        if self.signal is not None:
            self.stop()


@contextlib.contextmanager
def noted(notice: str | None = None, cluster: Cluster = ALONE) -> Iterator[Interruption]:
    """Note the first SIGINT or SIGTERM of this block; a later one acts as it would outside.

    Args:
        notice: written to standard output at the first.
        cluster: the processes that stop together.
    """
    first = 0.0
    before = {number: signal.getsignal(number) for number in SIGNALS}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, _: FrameType | None) -> None:
        nonlocal first
        if interruption.signal is None:
            interruption.signal, first = number, time.monotonic()
            if notice is not None:
                # The signal may have interrupted `print`, or ended whoever reads the output.
                with contextlib.suppress(OSError):
                    os.write(1, notice.encode())
        elif time.monotonic() - first >= TWICE:
            restore()
            signal.raise_signal(number)

    # Started without standard output, the process may have another file at descriptor 1.
    if sys.__stdout__ is None:
        notice = None
    interruption = Interruption(cluster, restore)
    for number in SIGNALS:
        signal.signal(number, note)
    try:
        yield interruption
    finally:
        restore()
