"""SIGINT and SIGTERM, noted while a run works and obeyed where it can go on from."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

from cmedirl_jax.runs.cluster import exchange

SIGNALS = (signal.SIGINT, signal.SIGTERM)
TWICE = 1.0
"""Seconds within which a second signal is the first once more: some schedulers send it twice."""


class Interrupted(Exception):
    """The run stopped because a signal asked it to.

    Attributes:
        exit_code: 128 and the signal's number, as shells have it.
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


class Interruption:
    """Which signal has asked this process to stop, if any."""

    def __init__(self, restore: Callable[[], None] = lambda: None):
        self.signal: int | None = None
        self._restore = restore

    def came(self) -> bool:
        """Whether a signal has asked any process of the run to stop: a collective of them all."""
        return exchange.any_process(self.signal is not None)

    def stop(self) -> NoReturn:
        """Stop here.

        Raises:
            Interrupted: by this process's signal; SIGTERM, if it was another's.
        """
        raise Interrupted(signal.SIGTERM if self.signal is None else self.signal)

    def release(self) -> None:
        """Let signals act at once from here on, where there is nothing left to save.

        Raises:
            Interrupted: if one came before.
        """
        self._restore()
        if self.signal is not None:
            self.stop()


@contextlib.contextmanager
def noted(notice: str | None = None) -> Iterator[Interruption]:
    """Note the first SIGINT or SIGTERM of this block; a later one acts as it would without it.

    Args:
        notice: written to standard output at the first.
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
                # `print` may be what the signal interrupts; the reader may have ended by it.
                with contextlib.suppress(OSError):
                    os.write(1, notice.encode())
        elif time.monotonic() - first >= TWICE:
            restore()
            signal.raise_signal(number)

    # Descriptor 1 is another file's where the run was started without standard output.
    if sys.__stdout__ is None:
        notice = None
    interruption = Interruption(restore)
    for number in SIGNALS:
        signal.signal(number, note)
    try:
        yield interruption
    finally:
        restore()
