"""The programs that people copy."""

import importlib.util
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs
from cmedirl_jax.agents import ddpg
from cmedirl_jax.io import export
from tests.support import ROOT

SIZES = {"observation": 4, "action": 2}
PROGRAMS = (
    *("own_task", "ddpg_in_a_scan", "irl_in_another_loop", "population"),
    "reward_without_the_library",
)


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


def test_a_reward_that_was_carried_away_needs_numpy_alone(tmp_path):
    carry(tmp_path / "r_d", envs.make("PointMass-v0"))
    card = tmp_path / "r_d" / "card.json"
    spaces = {name: {"low": [-1.0] * n, "high": [1.0] * n} for name, n in SIZES.items()}
    card.write_text(json.dumps(json.loads(card.read_text()) | spaces))
    program = (sys.executable, "-I", ROOT / "examples" / "reward_without_the_library.py")
    blocked = "import sys; sys.modules['jax'] = sys.modules['cmedirl_jax'] = None; "
    run = f"import runpy; sys.argv = {[str(program[2]), str(tmp_path / 'r_d')]}; "
    code = blocked + run + "runpy.run_path(sys.argv[0], run_name='__main__')"
    done = subprocess.run([*program[:2], "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("PointMass-v0: r_D is -0.1")


def test_a_reward_is_learned_on_a_task_of_ones_own():
    pilot, before, after = example("own_task").main(seeds=2, steps=1_000)
    assert before < 3.0 * pilot
    assert after > 0.6 * before


def test_ddpg_learns_in_a_scan_of_ones_own():
    first, last = example("ddpg_in_a_scan").main(steps=3_000, seeds=2)
    assert last > first + 0.5


def test_another_agent_learns_from_the_irl_update():
    shown, before, after = example("irl_in_another_loop").main(generations=60)
    assert before < 0.1 * shown
    assert after > before + 0.5


def test_a_population_breeds_its_hyperparameters():
    population = example("population")
    agent = ddpg.make(envs.make("Pendulum-v1").spec)
    agents = jax.jit(jax.vmap(agent.init))(jax.random.split(jax.random.key(0), 8))
    rates = {name: np.linspace(1e-4, 8e-4, 8, dtype=np.float32) for name in population.RATES}
    agents = agents.replace(hparams=agents.hparams.replace(**rates))
    bred = jax.jit(population.breed)(jax.random.key(1), agents, jnp.arange(8.0))
    for name, before in rates.items():
        after = np.asarray(getattr(bred.hparams, name))
        np.testing.assert_array_equal(after[4:], before[4:])
        # By factors of e^(half a standard normal number).
        change = np.abs(np.log(after[:4] / before[4:]))
        assert (change > 0.0).all()
        assert (change < 2.5).all()
    rest = (each.replace(hparams=None) for each in jax.device_get((agents, bred)))
    for before, after in zip(*map(jax.tree.leaves, rest), strict=True):
        np.testing.assert_array_equal(after, np.concatenate([before[4:], before[4:]]))


def test_a_population_goes_on_with_what_was_bred(monkeypatch):
    population = example("population")
    population.AGENTS = 8

    def spoil(key, agents, returns):
        return agents.replace(actor=jax.tree.map(lambda leaf: jnp.nan * leaf, agents.actor))

    monkeypatch.setattr(population, "breed", spoil)
    first, last = population.main(generations=2, steps=250)
    assert np.isfinite(first)
    assert np.isnan(last)


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_five_programs_are_short(name):
    assert len((ROOT / "examples" / f"{name}.py").read_text().splitlines()) <= 60


def test_stable_baselines_trains_on_it(tmp_path):
    pytest.importorskip("stable_baselines3")
    carry(tmp_path / "r_d", envs.make("Pendulum-v1"))
    program = (sys.executable, ROOT / "examples" / "sb3_on_learned_reward.py", tmp_path / "r_d")
    options = ("--seeds", "1", "--steps", "400")
    done = subprocess.run([*program, *options], capture_output=True, text=True, check=True)
    assert [line.split(",")[0] for line in done.stdout.splitlines()[1::2]] == ["r_e", "replace"]
