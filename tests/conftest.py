import ctypes
import gc
import os
import signal

import hypothesis
import jax
import numpy as np
import platformdirs
import psutil
import pytest

from cmedirl_jax import envs
from cmedirl_jax.types import EnvSpec
from tests.support import compiling, runs

# The first example of a test compiles, so deadlines would only measure the compiler.
# The examples are the same in every run: more of them would only be slower.
hypothesis.settings.register_profile(
    "reproducible", deadline=None, derandomize=True, max_examples=30
)
hypothesis.settings.load_profile("reproducible")

MOST_MEMORY = 1.7e9
"""Resident bytes of a process above which compiled programs are freed between tests."""

# Longest first: one of these files started last would keep a worker alone at the end.
LONGEST = (
    "experiments/test_run_grid.py",
    "end_to_end/test_faults.py",
    "runs/cluster/test_together.py",
    "training/test_trainer.py",
    "agents/test_ddpg.py",
    "end_to_end/test_refusals.py",
    "benchmarks/test_benchmarks.py",
)


def pytest_configure():
    compiling.be_quick()
    # Fixtures of a module come before what a test's own fixture sets.
    jax.config.update("jax_disable_most_optimizations", True)
    # A shell starts its background jobs with SIGINT ignored, which tests of signals cannot be.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items):
    def place(item):
        name = item.path.relative_to(item.config.rootpath / "tests").as_posix()
        return LONGEST.index(name) if name in LONGEST else len(LONGEST)

    items.sort(key=place)


def pytest_collection_finish():
    # Hypothesis makes its generator at its first example, and warns of one that only frozen objects
    # refer to.
    hypothesis.given(hypothesis.strategies.none())(lambda _: None)()
    # Modules stay until the end: the collector need not look through them again and again.
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def bounded_memory():
    """Compiled programs are freed after a test by whose end the process has grown large."""
    yield
    if psutil.Process().memory_info().rss > MOST_MEMORY:
        jax.clear_caches()
        gc.collect()
        # The C library keeps what is freed until it is told to give it back.
        if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
            trim(0)


@pytest.fixture(autouse=True, scope="session")
def no_users_cache(tmp_path_factory):
    """Commands run within the tests' process leave nothing in the user's cache."""
    # The tests after such a command would look for each of their small programs on the disk.
    jax.config.update("jax_enable_compilation_cache", False)
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(platformdirs, "user_cache_path", lambda *_, **__: folder)
        yield


@pytest.fixture(autouse=True)
def quick_compilation(request):
    """Most tests compile for longer than they run; the marked ones are optimised."""
    optimised = [request.node.get_closest_marker(name) for name in ("statistical", "optimised")]
    jax.config.update("jax_disable_most_optimizations", not any(optimised))


@pytest.fixture(scope="session")
def env():
    return envs.make("MountainCarContinuous-v0")


@pytest.fixture(scope="session")
def spec(env):
    return env.spec


@pytest.fixture(scope="session")
def skewed_spec():
    """Three observations, two actions, and no bound that is the negative of another."""
    return EnvSpec(
        id="Skewed-v0",
        observation_dim=3,
        action_dim=2,
        observation_low=np.array([-1.0, 0.0, 2.0], np.float32),
        observation_high=np.array([3.0, 0.5, 10.0], np.float32),
        action_low=np.array([-1.0, 0.5], np.float32),
        action_high=np.array([3.0, 1.0], np.float32),
        max_episode_steps=10,
        reward_threshold=0.0,
    )


@pytest.fixture(scope="session")
def untrained_run(tmp_path_factory):
    """A run's folder, which no test changes for the others."""
    folder = tmp_path_factory.mktemp("run")
    runs.save(folder)
    return folder


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Environment variables that make a module's commands compile quickly, and share the result."""
    return {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {compiling.QUICK_COMMANDS}",
    }


@pytest.fixture(scope="module")
def unoptimised(compiled):
    """The same for commands that train for a moment, and would compile for longer."""
    return compiled | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
