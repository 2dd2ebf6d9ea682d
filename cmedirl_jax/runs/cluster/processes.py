"""Starting and ending a run's processes: they meet, are watched, and end together."""

import errno
import os
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Sequence

import jax

from cmedirl_jax.runs.cluster.base import ALONE, Cluster, ClusterOptions
from cmedirl_jax.runs.cluster.together import Together
from cmedirl_jax.runs.console import streams
from cmedirl_jax.runs.errors import UserError

HEARTBEAT_TIMEOUT = 20
"""Seconds without a heartbeat after which a process counts as dead."""
GONE = (
    "another process is gone, or never came; "
    "start the same command on all machines again to continue"
)
_WORKER = "CMEDIRL_JAX_DISTRIBUTED_WORKER"


def check(options: ClusterOptions) -> None:
    """Refuse options that contradict each other.

    Raises:
        UserError: naming the option, what is wrong and what would be right.
    """
    if options.coordinator is None:
        for name in ("processes", "process_id"):
            if getattr(options, name) is not None:
                raise UserError(f"--{name.replace('_', '-')}: needs --coordinator HOST:PORT")
        return
    host, _, port = options.coordinator.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise UserError(f"--coordinator: must be HOST:PORT, got {options.coordinator}")
    if options.processes is None or options.process_id is None:
        raise UserError("--coordinator: needs --processes N and --process-id I too")
    if options.processes < 1:
        raise UserError(f"--processes: must be at least 1, got {options.processes}")
    if not 0 <= options.process_id < options.processes:
        last = options.processes - 1
        raise UserError(f"--process-id: must be between 0 and {last}, got {options.process_id}")


def supervise(module: str, arguments: Sequence[str]) -> int:
    """Run this process's share, `python -m MODULE ARGUMENTS`, in a child; returns its exit code.

    JAX's runtime aborts a process that loses the coordinator before Python can print a line: the
    parent prints it. The child ends when this process does.
    """
    child = subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        env=os.environ | {_WORKER: "1"},
        stdin=subprocess.PIPE,
        start_new_session=True,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: child.send_signal(number))
    code = child.wait()
    program = module.rpartition(".")[2]
    if code == -signal.SIGABRT:
        streams.complain(f"{program}: {GONE}")
        return 1
    if code < 0:
        streams.complain(f"{program}: ended by {signal.Signals(-code).name}")
        return 128 - code
    return code


def is_worker() -> bool:
    """Whether this process is a child of `supervise`."""
    return _WORKER in os.environ


def join(options: ClusterOptions) -> Cluster:
    """Meet the other processes, if there are any; before any other use of JAX.

    Raises:
        UserError: if JAX's cluster detection finds no cluster, or process 0 cannot listen.
    """
    if not options.several:
        return ALONE
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # The variable moves JAX's listener to another address: the coordinator's port says nothing.
    if options.process_id == 0 and "JAX_COORDINATOR_BIND_ADDRESS" not in os.environ:
        assert options.coordinator is not None
        _check_port(int(options.coordinator.rpartition(":")[2]))
    # SIGINT ends the process at once: as an exception it would leave the others waiting.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # JAX's preemption service would take SIGTERM.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            options.coordinator,
            options.processes,
            options.process_id,
            # JAX must look for no cluster where the options describe one.
            cluster_detection_method=None if options.coordinator is None else "deactivate",
            heartbeat_timeout_seconds=HEARTBEAT_TIMEOUT,
        )
    except ValueError as error:
        raise UserError(
            f"--distributed: JAX detects no cluster here ({error}); "
            "give --coordinator HOST:PORT --processes N --process-id I"
        ) from error
    return Together()


def _check_port(port: int) -> None:
    """Check that the coordinator can listen on a port: where it cannot, JAX ends by SIGSEGV.

    Raises:
        UserError: if it cannot.
    """
    # JAX listens on all addresses, by IPv6 where the machine has it.
    address = ("::", port) if socket.has_dualstack_ipv6() else ("", port)
    family = socket.AF_INET6 if socket.has_dualstack_ipv6() else socket.AF_INET
    try:
        with socket.socket(family) as listener:
            # Connections of a run that has just ended may linger on the port.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
            listener.bind(address)
    except OSError as error:
        used = error.errno == errno.EADDRINUSE
        reason = "is in use" if used else f"cannot be listened on ({error.strerror})"
        raise UserError(f"--coordinator: port {port} {reason}") from error


def guarded(program: str, run: Callable[[], int]) -> int:
    """Run a worker's share; if it fails alone, end at once so that the other processes notice."""
    try:
        code = run()
        # All processes end alike with 0, 2 or a signal's code, so none waits for another.
        if code != 1:
            return code
        streams.flush()
        os._exit(code)
    except Exception as error:
        # An ordinary exit would wait for the processes that wait for this one.
        lost = any(transport in str(error) for transport in ("Gloo", "NCCL", "oordination"))
        # Reading an array whose exchange failed raises ValueError.
        if isinstance(error, jax.errors.JaxRuntimeError | ValueError) and lost:
            streams.complain(f"{program}: {GONE}")
        else:
            streams.complain(traceback.format_exc().rstrip())
        streams.flush()
        os._exit(1)


def _end_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)
