"""How the tests' programs are compiled: quickly, as most of them compile longer than they run."""

import os
import subprocess
import sys

import jax

# XLA's older CPU code generator takes half the time; in one piece, a tenth less again.
QUICK = ("--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1")
# Commands train for as long as they compile: the cheap optimisations, which JAX's switch omits.
QUICK_COMMANDS = "--xla_backend_optimization_level=1 --xla_llvm_disable_expensive_passes=true"


def be_quick():
    """Set XLA's flags for this process and what it starts: xdist's workers, commands."""
    if not set(QUICK) & set(os.environ.get("XLA_FLAGS", "").split()):
        known = QUICK if _knows(*QUICK) else [flag for flag in QUICK if _knows(flag)]
        os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *known])


def _knows(*flags):
    """Whether this version of XLA knows the flags: one that it does not know ends the process."""
    start = [sys.executable, "-c", "import jax; jax.devices('cpu')"]
    environment = os.environ | {"XLA_FLAGS": " ".join(flags)}
    return not subprocess.run(start, env=environment, capture_output=True, check=False).returncode


def jit_as_users(function, compiler_options=None, **kwargs):
    """Jit with the code generator of a user's program, for tests marked as optimised."""
    older = QUICK[0] in os.environ["XLA_FLAGS"].split()
    generator = {"xla_cpu_use_fusion_emitters": True} if older else {}
    return jax.jit(function, compiler_options=generator | (compiler_options or {}), **kwargs)
