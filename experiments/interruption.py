"""SIGINT and SIGTERM, noted while a run works and obeyed where it can go on from."""

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(Exception):
    """The run stopped because a signal asked it to.

    Attributes:
        exit_code: 128 and the signal's number, as shells have it.
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


class Interruption:
    """Which signal has asked the run to stop, if any."""

    def __init__(self):
        self.signal: int | None = None

    def obey(self) -> None:
        """Stop here if a signal has asked for it.

        Raises:
            Interrupted: then.
        """
        if self.signal is not None:
            raise Interrupted(self.signal)


@contextlib.contextmanager
def noted() -> Iterator[Interruption]:
    """Note the first SIGINT or SIGTERM of this block; a second one acts as it would without it."""
    interruption = Interruption()
    before = {number: signal.getsignal(number) for number in SIGNALS}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, _: FrameType | None) -> None:
        interruption.signal = number
        restore()

    for number in SIGNALS:
        signal.signal(number, note)
    try:
        yield interruption
    finally:
        restore()
