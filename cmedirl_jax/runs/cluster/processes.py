"""The life of a run's processes: they meet, are watched, and end together; docs/scaling.md."""

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

from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.console import streams
from cmedirl_jax.runs.errors import UserError

HEARTBEAT_TIMEOUT = 20
"""Seconds after which a process that has fallen silent counts as dead."""
GONE = (
    "another process is gone, or never came; "
    "start the same command on all machines again to continue"
)
_WORKER = "CMEDIRL_JAX_DISTRIBUTED_WORKER"


def check(config: StudyConfig) -> None:
    """Refuse options that contradict each other.

    Raises:
        UserError: naming the option, what is wrong and what would be right.
    """
    if config.coordinator is None:
        for name in ("processes", "process_id"):
            if getattr(config, name) is not None:
                raise UserError(f"--{name.replace('_', '-')}: needs --coordinator HOST:PORT")
        return
    host, _, port = config.coordinator.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise UserError(f"--coordinator: must be HOST:PORT, got {config.coordinator}")
    if config.processes is None or config.process_id is None:
        raise UserError("--coordinator: needs --processes N and --process-id I too")
    if config.processes < 1:
        raise UserError(f"--processes: must be at least 1, got {config.processes}")
    if not 0 <= config.process_id < config.processes:
        last = config.processes - 1
        raise UserError(f"--process-id: must be between 0 and {last}, got {config.process_id}")


def is_asked(config: StudyConfig) -> bool:
    """Whether the run has several processes, of which this is one."""
    return config.distributed or config.coordinator is not None


def supervise(module: str, arguments: Sequence[str]) -> int:
    """Run this process's share, `python -m MODULE ARGUMENTS`, in a child; returns its exit code.

    JAX's runtime aborts a process that loses the coordinator, before Python can say a word; so
    somebody else must. The child ends when this process does.
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


def join(config: StudyConfig) -> None:
    """Meet the other processes; before any other use of JAX.

    Raises:
        UserError: if JAX's cluster detection finds no cluster, or process 0 cannot listen.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Else it listens where that says, and not on the coordinator's port.
    if config.process_id == 0 and "JAX_COORDINATOR_BIND_ADDRESS" not in os.environ:
        assert config.coordinator is not None
        _check_port(int(config.coordinator.rpartition(":")[2]))
    # At once, unless noted: an exception would leave the others waiting.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # It would take SIGTERM for itself.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            config.coordinator,
            config.processes,
            config.process_id,
            # With all four given, JAX looks for no cluster.
            cluster_detection_method=None if config.coordinator is None else "deactivate",
            heartbeat_timeout_seconds=HEARTBEAT_TIMEOUT,
        )
    except ValueError as error:
        raise UserError(
            f"--distributed: JAX detects no cluster here ({error}); "
            "give --coordinator HOST:PORT --processes N --process-id I"
        ) from error


def _check_port(port: int) -> None:
    """See that the coordinator can listen on a port, of which JAX would say no more than SIGSEGV.

    Raises:
        UserError: if it cannot.
    """
    # As JAX does: all addresses, by IPv6 where there is such a thing.
    address = ("::", port) if socket.has_dualstack_ipv6() else ("", port)
    family = socket.AF_INET6 if socket.has_dualstack_ipv6() else socket.AF_INET
    try:
        with socket.socket(family) as listener:
            # The connections of a run that has just ended are in nobody's way.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
            listener.bind(address)
    except OSError as error:
        used = error.errno == errno.EADDRINUSE
        reason = "is in use" if used else f"cannot be listened on ({error.strerror})"
        raise UserError(f"--coordinator: port {port} {reason}") from error


def guarded(program: str, run: Callable[[], int]) -> int:
    """Run a worker's share; where it fails alone end at once, so that the others learn of it."""
    try:
        code = run()
        # What all agree on they may leave in peace: 2, or a signal's code.
        if code != 1:
            return code
        streams.flush()
        os._exit(code)
    except Exception as error:
        # An ordinary exit would wait for the processes that wait for this one.
        lost = any(transport in str(error) for transport in ("Gloo", "NCCL", "oordination"))
        # A value that never came is a ValueError to whoever looks at it.
        if isinstance(error, jax.errors.JaxRuntimeError | ValueError) and lost:
            streams.complain(f"{program}: {GONE}")
        else:
            streams.complain(traceback.format_exc().rstrip())
        streams.flush()
        os._exit(1)


def _end_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)
