"""The two ends of a timed loop in a process of its own: `serve` in it, `Worker` outside.

Each loop runs in a separate process, with its own devices, cores, compiler and peak of memory. So
loops can be timed in turn, which cancels the drift of a shared machine. This module needs the
standard library alone: peers import it from environments in which nothing else is installed.
"""

import contextlib
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

try:
    import resource
except ImportError:  # Windows has no such accounting; the memory is then not reported.
    resource = None


_MARK = "answer: "
"""Begins the lines that are answers; libraries print other lines while they are imported."""

_PIN = """
import os, sys
os.sched_setaffinity(0, map(int, sys.argv[1].split(",")))
os.execvp(sys.argv[2], sys.argv[2:])
"""


def pinned(command: Sequence[str], cores: Sequence[int] | None) -> list[str]:
    """`command` on `cores` alone, if given and if the system can pin processes."""
    if cores is None or not hasattr(os, "sched_setaffinity"):
        return list(command)
    # A small program pins itself and becomes the command: code between fork and exec is unsafe in a
    # process where JAX has started threads.
    return [sys.executable, "-c", _PIN, ",".join(map(str, cores)), *command]


def serve(advance: Callable[[int], Any], steps: int, facts: Callable[[], dict] = dict) -> None:
    """Time `advance(steps)` for every line of standard input, which holds the steps, until it ends.

    Args:
        advance: takes that many steps with every learner, and returns when they are done; if it
            returns a dict, its fields are answered too.
        steps: of the first call, which compiles and is not counted.
        facts: further fields of the report after the first call.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)

    def answer(fields: dict[str, Any]) -> None:
        print(_MARK + json.dumps(fields), file=answers)

    with contextlib.redirect_stdout(sys.stderr):
        began = time.perf_counter()
        advance(steps)
        first = time.perf_counter() - began
        answer({"first_call_seconds": first, **facts()})
        for line in sys.stdin:
            began = time.perf_counter()
            found = advance(int(line))
            seconds = time.perf_counter() - began
            fields = found if isinstance(found, dict) else {}
            answer({"seconds": seconds, "peak_memory_bytes": peak_memory(), **fields})


def serve_from_command_line(
    advance: Callable[[int], Any], facts: Callable[[], dict] = dict
) -> None:
    """`serve`, with the steps of the first call as the command's last argument."""
    serve(advance, int(sys.argv[-1]), facts)


class Worker:
    """A process that serves a loop.

    Attributes:
        peak_memory_bytes: its resident memory's peak so far, or None where it is not accounted for.
    """

    def __init__(self, command: Sequence[str], cores: Sequence[int] | None, **environment: str):
        """Start `command`, on `cores` alone if given and if the system can pin processes."""
        root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
        # A file, since a pipe that nobody reads would block a process with many messages.
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self._process = subprocess.Popen(
            pinned(command, cores),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env={**os.environ, "PYTHONPATH": root, **environment},
        )
        self.peak_memory_bytes: int | None = None

    @functools.cached_property
    def facts(self) -> dict[str, Any]:
        """What the loop reported after its first call; waits for it.

        Raises:
            RuntimeError: with the end of its errors, if it never gets there.
        """
        return self._answer()

    def wait(self) -> None:
        """Wait until the first call is done; raises what `facts` raises."""
        _ = self.facts

    def seconds(self, steps: int) -> float:
        """How long the learners take for `steps` steps each, after the first call."""
        return self.ask(steps)["seconds"]

    def ask(self, steps: int) -> dict[str, Any]:
        """Let the learners take `steps` steps each, after the first call; what the loop answers."""
        self.wait()
        assert self._process.stdin is not None
        self._process.stdin.write(f"{steps}\n")
        self._process.stdin.flush()
        answer = self._answer()
        self.peak_memory_bytes = answer["peak_memory_bytes"]
        return answer

    def stop(self) -> None:
        """End the process."""
        self._process.communicate()
        self._errors.close()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith(_MARK):
                return json.loads(line.removeprefix(_MARK))
        self._process.wait()
        self._errors.seek(0)
        raise RuntimeError(self._errors.read()[-2000:])


def peak_memory() -> int | None:
    """Bytes that this process has held at most; None where the system does not say."""
    # On Linux, getrusage includes the peak of the parent that the process was forked from.
    if sys.platform == "linux":
        with open("/proc/self/status") as status:
            lines = dict(line.split(":", 1) for line in status)
        return 1024 * int(lines["VmHWM"].split()[0])
    if resource is None:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
