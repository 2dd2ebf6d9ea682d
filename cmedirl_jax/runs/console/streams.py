"""Standard output and standard error that may fail: a run goes on without them."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import TextIO, cast


class _Dispensable:
    """A stream whose text is thrown away once a write has failed."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except UnicodeEncodeError:
            encoding = self._stream.encoding
            return self.write(text.encode(encoding, "replace").decode(encoding))
        except OSError:
            _discard(self._stream)
            return len(text)

    def flush(self) -> None:
        _flush(self._stream)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


def dispensable() -> TextIO | None:
    """Standard output that never raises OSError; None where it is closed."""
    return _dispensable(sys.stdout)


def complain(line: str) -> None:
    """Print a line on standard error, if that is still there."""
    if sys.stderr is not None:
        print(line, file=_dispensable(sys.stderr), flush=True)


@contextlib.contextmanager
def unfailing() -> Iterator[None]:
    """Let whatever prints in this block do without the stream that is closed or fails."""
    with contextlib.ExitStack() as stack:
        nowhere = stack.enter_context(open(os.devnull, "w"))
        stack.enter_context(contextlib.redirect_stdout(_dispensable(sys.stdout) or nowhere))
        stack.enter_context(contextlib.redirect_stderr(_dispensable(sys.stderr) or nowhere))
        stack.callback(flush)
        yield


def flush() -> None:
    """Flush both. Text that cannot be written is dropped: Python would fail on it at exit."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            _flush(stream)


def _dispensable(stream: TextIO | None) -> TextIO | None:
    return None if stream is None else cast(TextIO, _Dispensable(stream))


def _flush(stream: TextIO) -> None:
    try:
        stream.flush()
    except OSError:
        _discard(stream)


def _discard(stream: TextIO) -> None:
    # The text that the stream still holds is lost too. Not every stream has a descriptor.
    with contextlib.suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, stream.fileno())
        finally:
            os.close(nowhere)
