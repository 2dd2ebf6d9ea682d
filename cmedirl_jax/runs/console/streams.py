"""Standard output and standard error, which a run goes on without where they are gone."""

import contextlib
import os
import sys
from typing import TextIO, cast


class _Dispensable:
    """A stream that leads nowhere from the first failed write on."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except UnicodeEncodeError:
            encoding = self._stream.encoding
            return self.write(text.encode(encoding, "replace").decode(encoding))
        except OSError:
            _lead_nowhere(self._stream)
            return len(text)

    def flush(self) -> None:
        _flush(self._stream)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


def dispensable() -> TextIO | None:
    """Standard output, for a writer that may not fail; None where it is closed."""
    return _dispensable(sys.stdout)


def complain(line: str) -> None:
    """Print a line on standard error, if that is still there."""
    if sys.stderr is not None:
        print(line, file=_dispensable(sys.stderr), flush=True)


def flush() -> None:
    """Flush both; what cannot be written must not fail again when Python does so at its end."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            _flush(stream)


def _dispensable(stream: TextIO | None) -> TextIO | None:
    return None if stream is None else cast(TextIO, _Dispensable(stream))


def _flush(stream: TextIO) -> None:
    try:
        stream.flush()
    except OSError:
        _lead_nowhere(stream)


def _lead_nowhere(stream: TextIO) -> None:
    # What the stream still holds goes there too. Not every stream has a descriptor.
    with contextlib.suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, stream.fileno())
        finally:
            os.close(nowhere)
