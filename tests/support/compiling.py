"""How the tests' programs are compiled: quickly, as most of them compile longer than they run."""

import os
import subprocess
import sys

import jax

# XLA's older CPU code generator takes half the time; in one piece, a tenth less again.
QUICK = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
# Commands train for as long as they compile: the cheap optimisations, which JAX's switch omits.
QUICK_COMMANDS = "--xla_backend_optimization_level=1 --xla_llvm_disable_expensive_passes=true"


def be_quick():
    """Set XLA's flags for this process and what it starts: xdist's workers, commands."""
    if is_quick():
        return
    environment = os.environ | {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {QUICK}".strip()}
    # A flag that this version of XLA does not know ends the process.
    start = [sys.executable, "-c", "import jax; jax.devices('cpu')"]
    done = subprocess.run(start, env=environment, capture_output=True, check=False)
    if done.returncode == 0:
        os.environ.update(environment)


def is_quick():
    return QUICK in os.environ.get("XLA_FLAGS", "")


def jit_as_users(function, **kwargs):
    """Jit with the code generator of a user's program, for tests marked as optimised."""
    options = {"xla_cpu_use_fusion_emitters": True} if is_quick() else None
    return jax.jit(function, **kwargs, compiler_options=options)
