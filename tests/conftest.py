import os

import hypothesis
import jax
import numpy as np
import platformdirs
import pytest

from cmedirl_jax import envs
from cmedirl_jax.types import EnvSpec
from tests.support import compiling

# The first example of a test compiles, so deadlines would only measure the compiler.
hypothesis.settings.register_profile("reproducible", deadline=None, derandomize=True)
hypothesis.settings.load_profile("reproducible")


def pytest_configure():
    compiling.be_quick()


@pytest.fixture(autouse=True, scope="session")
def no_users_cache(tmp_path_factory):
    """Commands run within the tests' process leave nothing in the user's cache."""
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


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Environment variables that make a module's commands compile quickly, and share the result."""
    return {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {compiling.QUICK_COMMANDS}",
    }
