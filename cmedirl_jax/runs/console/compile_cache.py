"""The compiler's cache on disk, and the count of what compiling cost."""

import contextlib
import dataclasses
from collections.abc import Iterator

import jax
import platformdirs

from cmedirl_jax.io import atomic

_DURATIONS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)
_HIT, _MISS = "/jax/compilation_cache/cache_hits", "/jax/compilation_cache/cache_misses"


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
    """
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        try:
            folder = platformdirs.user_cache_path("cmedirl_jax", appauthor=False) / "compiled"
            atomic.check_writable(folder)
        except (OSError, RuntimeError):
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
    # Small programs too: there are many, and each would be compiled at every start.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
