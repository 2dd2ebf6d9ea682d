"""What a logger is: it opens writers, each of which writes one series of scalars over steps."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol


class Point(NamedTuple):
    """The scalars of a series at one environment step; all are finite."""

    step: int
    scalars: Mapping[str, float]


class Writer(Protocol):
    """Writes one series. Whatever it raises ends the log, not the run."""

    def write(self, points: Sequence[Point]) -> None:
        """Add the points that have come since the last call; they are in the order of steps."""
        ...

    def close(self) -> None:
        """Bring to the disk what is not there yet; the last call."""
        ...


class Logger(NamedTuple):
    """A kind of log.

    Attributes:
        open: `(folder, series, config) -> Writer`. The folder `log/CELL` is named as the cell is,
            and holds nothing of this logger yet; `series` is the file's or the run's name within
            it, and `config` the run's configuration as JSON values.
        package: the module that it imports when it is opened, of the extra `log`; None for none.
    """

    open: Callable[[Path, str, Mapping[str, Any]], Writer]
    package: str | None = None
