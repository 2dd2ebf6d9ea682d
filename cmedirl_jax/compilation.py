"""Compilation of large programs on a CPU: in less time, to programs that are as fast."""

import os
from collections.abc import Callable
from typing import Any

import jax

_LEVEL = "xla_backend_optimization_level"


def jit(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit`, which has LLVM optimise less on a CPU, where that costs nothing.

    With the first of LLVM's levels training is as fast as with the third, the default, and has the
    same numbers up to rounding (docs/performance.md). It is for programs that take seconds to
    compile, and are called by themselves: JAX refuses compiler options within another `jit`.

    Args:
        function: what to compile.
        **options: of `jax.jit`, other than `compiler_options`.

    Returns:
        As `jax.jit`. On other platforms, and where `XLA_FLAGS` has another level or
        `jax_disable_most_optimizations` is set, it is no more than that.
    """
    return jax.jit(function, **options, compiler_options=_options())


def _options() -> dict[str, Any] | None:
    flags = os.environ.get("XLA_FLAGS", "")
    other = _LEVEL in flags and f"{_LEVEL}=1" not in flags
    told = other or jax.config.read("jax_disable_most_optimizations")
    return None if told or jax.default_backend() != "cpu" else {_LEVEL: 1}
