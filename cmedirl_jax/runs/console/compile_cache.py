"""The compiler's cache on disk, and the count of what compiling cost."""

import contextlib
import dataclasses
import importlib
import os
import tempfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import platformdirs

from cmedirl_jax.io import atomic

_DURATIONS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)
_HIT, _MISS = "/jax/compilation_cache/cache_hits", "/jax/compilation_cache/cache_misses"
_CHECKED = ".cmedirl_jax-checked"
"""A file in the cache's folder: entries that are older than it were found whole."""


@dataclasses.dataclass
class Cost:
    """The cost of compiling so far.

    Attributes:
        seconds: for tracing, lowering, compiling and reading the cache. A function traced within
            another counts twice, so this is an upper bound.
        hits: programs that were found in the cache.
        misses: programs that were looked for in the cache and not found.
    """

    seconds: float = 0.0
    hits: int = 0
    misses: int = 0


@contextlib.contextmanager
def counted() -> Iterator[Cost]:
    """Count what compiling costs while this block runs."""
    cost = Cost()

    def spent(event: str, duration_secs: float, **_: str | int) -> None:
        if event in _DURATIONS:
            cost.seconds += duration_secs

    def happened(event: str, **_: str | int) -> None:
        cost.hits += event == _HIT
        cost.misses += event == _MISS

    jax.monitoring.register_event_duration_secs_listener(spent)
    jax.monitoring.register_event_listener(happened)
    try:
        yield cost
    finally:
        jax.monitoring.unregister_event_duration_listener(spent)
        jax.monitoring.unregister_event_listener(happened)


def use_cache() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX was told where to keep them.

    Where the user has no home, or none that can be written, they are compiled at every start.

    JAX writes entries in place. One that a kill or a full disk cut short is removed here: JAX would
    warn of it, and compile its program again, at every start.
    """
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is None:
        try:
            users = platformdirs.user_cache_path("cmedirl_jax", appauthor=False) / "compiled"
            atomic.check_writable(users)
        except (OSError, RuntimeError):
            return
        folder = str(users)
        jax.config.update("jax_compilation_cache_dir", folder)
    # Small programs too: there are many, and each would be compiled at every start.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # JAX itself complains of a folder that it cannot use; without a name there is no cache.
    if folder and Path(folder).is_dir():
        with contextlib.suppress(OSError):
            _remove_cut_short(Path(folder))


def _remove_cut_short(folder: Path) -> None:
    """Remove entries that are not whole, of those written since the last check."""
    checked = folder / _CHECKED
    before = checked.stat().st_mtime_ns if checked.exists() else 0
    # The time before the check, by the clock of the folder's file system.
    with tempfile.TemporaryFile(dir=folder) as file:
        now = os.fstat(file.fileno()).st_mtime_ns
    decompressors = _decompressors()
    for entry in folder.glob("*-cache"):
        # Another process may remove it first, or it is another user's.
        with contextlib.suppress(OSError):
            if entry.stat().st_mtime_ns >= before and not _whole(entry.read_bytes(), decompressors):
                entry.unlink()
    checked.touch()
    os.utime(checked, ns=(now, now))


def _decompressors() -> dict[bytes, Callable[[bytes], bytes]]:
    """What decompresses entries, by their first byte: zlib, and zstd where JAX finds it."""
    found: dict[bytes, Callable[[bytes], bytes]] = {zlib.compress(b"")[:1]: zlib.decompress}
    for module in ("zstandard", "compression.zstd"):
        with contextlib.suppress(ImportError):
            found[b"\x28"] = importlib.import_module(module).decompress
    return found


def _whole(entry: bytes, decompressors: dict[bytes, Callable[[bytes], bytes]]) -> bool:
    """Whether an entry can be decompressed; one of an unknown compressor counts as whole."""
    if not entry:
        return False
    try:
        decompressors.get(entry[:1], bytes)(entry)
    except Exception:
        return False
    return True
