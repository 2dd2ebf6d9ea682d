"""Compilation of large programs on a CPU: in two thirds of the time, to equally fast ones."""

import os
from collections.abc import Callable
from typing import Any

import jax

_LEVEL = "xla_backend_optimization_level"


def jit(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit`, which has LLVM optimise less on a CPU, where that costs nothing.

    With the first of LLVM's levels training has the rate of the third, the default, and the same
    numbers up to rounding (docs/performance.md). It is for programs that take seconds to compile.

    Args:
        function: what to compile.
        **options: of `jax.jit`, other than `compiler_options`.

    Returns:
        As `jax.jit`. On other platforms, and where `XLA_FLAGS` or JAX's configuration say how much
        to optimise, it is no more than that.
    """
    return jax.jit(function, **options, compiler_options=_options())


def _options() -> dict[str, Any] | None:
    least = jax.config.read("jax_disable_most_optimizations")
    told = least or _LEVEL in os.environ.get("XLA_FLAGS", "")
    return None if told or jax.default_backend() != "cpu" else {_LEVEL: 1}
