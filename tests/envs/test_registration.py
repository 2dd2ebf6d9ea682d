"""Our tasks under names that Gymnasium knows."""

import subprocess
import sys

import gymnasium
import jax
import numpy as np

from cmedirl_jax import envs
from cmedirl_jax.envs import registration
from tests.support import ROOT

REGISTERED = ["cmedirl_jax/MountainCarContinuous-v0", "cmedirl_jax/Pendulum-v1"]


def test_gymnasium_finds_them_where_nothing_was_imported():
    script = (
        "import gymnasium\n"
        "env = gymnasium.make('cmedirl_jax:cmedirl_jax/Pendulum-v1')\n"
        "print(env.spec.id, env.reset(seed=0)[0].shape)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "cmedirl_jax/Pendulum-v1 (3,)\n"


def test_the_time_limit_is_that_of_make_or_of_the_parameters():
    env = gymnasium.make("cmedirl_jax/Pendulum-v1", max_episode_steps=300)
    env.reset(seed=0)
    flags = [env.step(np.zeros(1, np.float32))[3] for _ in range(300)]
    assert flags == [False] * 299 + [True]
    task = envs.make("Pendulum-v1")
    short = envs.to_gymnasium(task, task.default_params.replace(max_episode_steps=3))
    short.reset(seed=0)
    assert [short.step(np.zeros(1, np.float32))[3] for _ in range(3)] == [False, False, True]


def test_registering_twice_changes_nothing():
    before = [gymnasium.spec(name) for name in REGISTERED]
    registration.register()
    assert [gymnasium.spec(name) for name in REGISTERED] == before
    assert jax.tree.leaves(before)
