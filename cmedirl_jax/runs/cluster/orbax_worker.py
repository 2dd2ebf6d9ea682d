"""A process that calls orbax for another which shares its run with more.

Orbax's `save` meets all processes of `jax.distributed`, also when told that one is active.
"""

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
    """Call a function of orbax's, where need be in a process that knows of no others.

    The arguments and the result are pickled then, on their way through a pipe of our own.
    """
    if jax.process_count() == 1:
        return function(*arguments)
    with _ONE_AT_A_TIME:
        clerk = _clerk()
        clerk.send((function, arguments))
        error, result = clerk.recv()
    if error is not None:
        raise error
    return result


@functools.cache
def _clerk() -> multiprocessing.connection.Connection:
    spawn = multiprocessing.get_context("spawn")
    mine, clerks = spawn.Pipe()
    spawn.Process(target=_serve, args=(clerks,)).start()
    clerks.close()
    atexit.register(mine.close)
    return mine


def _serve(caller: multiprocessing.connection.Connection) -> None:
    """Call what `caller` sends, until it is gone."""
    jax.config.update("jax_platforms", "cpu")
    # Whoever stops the run stops the caller, who may still want something saved.
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
