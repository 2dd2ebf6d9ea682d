"""The programs that people copy."""

import importlib.util
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs
from cmedirl_jax.io import export
from tests.support import ROOT


def example(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def nearness(goal, observation, action):
    del action
    return -0.1 * jnp.linalg.norm(observation[..., :2] - goal, axis=-1)


def carry(folder, env):
    """Export a reward of being near a place, which is the goal of the point mass."""
    inputs = {"observation": env.spec.observation_dim, "action": env.spec.action_dim}
    reward = export.Function(nearness, jnp.array([0.7, 0.7]), inputs)
    export.save(folder, {"reward": reward}, {"task": env.spec.id})


def test_a_loop_of_ones_own_learns_from_a_reward_that_was_carried_away(tmp_path):
    carry(tmp_path / "r_d", envs.make("PointMass-v0"))
    exported = export.load(tmp_path / "r_d")
    env, reward = envs.make(exported.card["task"]), exported.functions["reward"]
    train = example("purejaxrl_loop").make_train(env, reward, updates=60)
    paid = np.asarray(jax.jit(train)(jax.random.key(0)))
    # From the discs and the way there to the goal and its bonus.
    assert paid[:5].mean() < -0.05
    assert paid[-10:].mean() > 0.0


def test_stable_baselines_trains_on_it(tmp_path):
    pytest.importorskip("stable_baselines3")
    carry(tmp_path / "r_d", envs.make("Pendulum-v1"))
    program = (sys.executable, ROOT / "examples" / "sb3_on_learned_reward.py", tmp_path / "r_d")
    options = ("--seeds", "1", "--steps", "400")
    done = subprocess.run([*program, *options], capture_output=True, text=True, check=True)
    assert [line.split(",")[0] for line in done.stdout.splitlines()[1::2]] == ["r_e", "replace"]
