"""Runs orbax in a child process: under `jax.distributed`, `save` waits for every process."""

import atexit
import contextlib
import functools
import multiprocessing.connection
import signal
import threading
from collections.abc import Callable
from typing import Any

import jax

_ONE_AT_A_TIME = threading.Lock()


def call(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of orbax's in the child. Arguments and result are pickled on the way."""
    with _ONE_AT_A_TIME:
        child = _child()
        child.send((function, arguments))
        error, result = child.recv()
    if error is not None:
        raise error
    return result


@functools.cache
def _child() -> multiprocessing.connection.Connection:
    """Start the child at the first call; it ends with this process."""
    spawn = multiprocessing.get_context("spawn")
    parents_end, childs_end = spawn.Pipe()
    spawn.Process(target=_serve, args=(childs_end,)).start()
    childs_end.close()
    atexit.register(parents_end.close)
    return parents_end


def _serve(caller: multiprocessing.connection.Connection) -> None:
    """Call what `caller` sends, until it is gone."""
    jax.config.update("jax_platforms", "cpu")
    # A signal to stop reaches the caller too, which may still want a checkpoint saved.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(EOFError):
        while True:
            function, arguments = caller.recv()
            try:
                answer = None, function(*arguments)
            except Exception as error:
                answer = error, None
            caller.send(answer)
