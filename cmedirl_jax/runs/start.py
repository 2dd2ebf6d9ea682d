"""How a command starts: its heap, JAX's devices, and the processes that share the run."""

import contextlib
import ctypes
import os
import sys
from typing import Any

import jax

from cmedirl_jax.runs import numerics
from cmedirl_jax.runs.cluster import processes
from cmedirl_jax.runs.cluster.base import Cluster, ClusterOptions
from cmedirl_jax.runs.errors import UserError

_M_ARENA_MAX = -8
"""`malloc.h`; see mallopt(3)."""
FEWEST = 4
"""Seeds below which a further core is of no use: fewer do not fill a vector unit."""
FEWEST_ON_HOST = 32
"""The same for a task on the host (docs/performance.md)."""


def start(
    options: ClusterOptions,
    count: int | None,
    seeds: int,
    same: dict[str, Any],
    fewest: int = FEWEST,
) -> tuple[Cluster, list[Any]]:
    """Start JAX with as many CPU devices as the run uses, or take the GPUs there are.

    Call it before anything else of JAX: the first array fixes the number of CPU devices.

    Args:
        options: which processes share the run.
        count: devices of each process; None: every core or GPU that is of use.
        seeds: how many seeds share the devices.
        same: options that must be equal on all processes, JSON values; so must `numerics` be.
        fewest: seeds for each of several cores.

    Returns:
        The processes, and the devices of all of them.

    Raises:
        UserError: if more devices are asked for than there are, JAX's platform is not here, or the
            processes do not agree.
    """
    share_heap(arenas=cores())
    wanted = count or max(1, min(cores(), seeds // fewest))
    if count is None or 1 <= count <= cores():
        # In a second call within one process JAX keeps the devices that it has.
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", wanted)
    cluster = processes.join(options)
    local = devices()
    available = len(local) if local[0].platform != "cpu" else cores()
    refused = count is not None and count > available
    # All processes refuse together: one that left alone would keep the others waiting.
    if cluster.any(refused):
        there = f"there are {available}" if refused else "another process has fewer"
        raise UserError(f"--devices: {count} asked, {there}")
    cluster.check_same(same | numerics.current())
    return cluster, cluster.devices(None if count is None else max(count, 1), seeds)


def devices() -> list[Any]:
    """This process's devices; starts JAX.

    Raises:
        UserError: if the platform that JAX_PLATFORMS asks for is not here, or JAX cannot start.
    """
    try:
        return jax.local_devices()
    # JAX asserts that it found a platform where it knows the name and lacks the plugin.
    except (RuntimeError, AssertionError) as error:
        asked = jax.config.jax_platforms  # pyright: ignore[reportAttributeAccessIssue]
        reason = " ".join(str(error).split()) or "it is not installed, or has no device"
        if not asked:
            raise UserError(f"JAX cannot start here: {reason}") from error
        raise UserError(
            f"JAX_PLATFORMS={asked}: JAX finds no such platform here ({reason}); "
            "give another, or cpu"
        ) from error


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_heap(arenas: int) -> None:
    """Make the threads of this process share so many of glibc's arenas.

    By default there are up to eight a core, and each keeps the memory that a thread once needed: a
    run of many cells grows by megabytes a cell (docs/reliability.md). Does nothing where
    MALLOC_ARENA_MAX is set, or with another C library.
    """
    if sys.platform.startswith("linux") and "MALLOC_ARENA_MAX" not in os.environ:
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_M_ARENA_MAX, arenas)
