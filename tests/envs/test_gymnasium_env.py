"""This library's tasks as Gymnasium's."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cmedirl_jax import envs

REGISTERED = ["cmedirl_jax/MountainCarContinuous-v0", "cmedirl_jax/Pendulum-v1"]


@pytest.mark.parametrize("name", REGISTERED)
def test_gymnasiums_checker_finds_nothing(name):
    with warnings.catch_warnings():
        # It advises actions in [-1, 1], which a pendulum's torque is not.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized space.*")
        check_env(gymnasium.make(name).unwrapped)


def test_gymnasiums_checker_finds_nothing_in_a_task_without_a_picture():
    check_env(envs.to_gymnasium(envs.make("PointMass-v0")))
    with pytest.raises(ValueError, match=r"PointMass-v0 has no picture 'rgb_array'.*\[\]"):
        envs.to_gymnasium(envs.make("PointMass-v0"), render_mode="rgb_array")
    with pytest.raises(ValueError, match="Pendulum-v1 has no picture 'ansi'"):
        envs.to_gymnasium(envs.make("Pendulum-v1"), render_mode="ansi")


@pytest.mark.parametrize("name", REGISTERED)
def test_it_takes_the_steps_of_gymnasiums_own(name):
    ours = gymnasium.make(name)
    theirs = gymnasium.make(name.removeprefix("cmedirl_jax/"))
    theirs.reset(seed=0)
    ours.reset(seed=5)
    task = envs.make(theirs.spec.id)
    theirs.unwrapped.state = task.gymnasium_state(ours.unwrapped._episode.state)
    generator, ended, steps = np.random.default_rng(0), False, 0
    while not ended and steps < 300:
        action = generator.uniform(ours.action_space.low, ours.action_space.high).astype(np.float32)
        mine, yours = ours.step(action), theirs.step(action)
        np.testing.assert_allclose(mine[0], yours[0], rtol=1e-3, atol=1e-4)
        assert mine[1] == pytest.approx(yours[1], rel=1e-3, abs=1e-4)
        assert mine[2:4] == yours[2:4]
        ended, steps = mine[2] or mine[3], steps + 1
    assert steps >= 200


def test_a_seed_decides_all_episodes_after_it():
    env = gymnasium.make("cmedirl_jax/Pendulum-v1")
    runs = []
    for _ in range(2):
        first, _ = env.reset(seed=7)
        runs.append((first, env.reset()[0], env.reset()[0]))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert len(np.unique(np.array(runs[0]), axis=0)) == 3


def test_a_frame_shows_the_state_and_the_torque(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gymnasium.make("cmedirl_jax/Pendulum-v1", render_mode="rgb_array")
    env.reset(seed=1)
    theirs = gymnasium.make("Pendulum-v1", render_mode="rgb_array")
    theirs.reset(seed=0)
    task = envs.make("Pendulum-v1")
    theirs.unwrapped.state = task.gymnasium_state(env.unwrapped._episode.state)
    np.testing.assert_array_equal(env.render(), theirs.render())
    action = np.float32([1.5])
    env.step(action)
    theirs.step(action)
    shown, expected = env.render(), theirs.render()
    assert shown.dtype == np.uint8
    assert np.mean(shown != expected) < 1e-3
    window = gymnasium.make("cmedirl_jax/MountainCarContinuous-v0", render_mode="human")
    window.reset(seed=0)
    window.step(np.zeros(1, np.float32))
    assert window.render() is None
    films = gymnasium.make("cmedirl_jax/Pendulum-v1", render_mode="rgb_array_list")
    films.reset(seed=0)
    films.step(action)
    assert len(films.render()) == 2
    for each in (env, theirs, window, films):
        each.close()


@pytest.mark.parametrize("call", ["step", "render"])
def test_it_must_be_reset_first(call):
    env = envs.to_gymnasium(envs.make("Pendulum-v1"))
    with pytest.raises(gymnasium.error.ResetNeeded, match=f"call reset before {call}"):
        env.step(np.zeros(1)) if call == "step" else env.render()


def test_a_task_goes_out_and_comes_back_in():
    task = envs.make("PointMass-v0")
    back = envs.from_gymnasium(lambda: envs.to_gymnasium(task))
    for name, value in back.spec._asdict().items():
        np.testing.assert_array_equal(value, getattr(task.spec, name), err_msg=name)
