"""Many episodes at once, beside Gymnasium's vector of single ones."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from cmedirl_jax import envs

MODES = list(AutoresetMode)
COUNT = 3


def short_cars():
    """Cars that begin at different places near the goal, so that some reach it within 8 steps."""
    task = envs.make("MountainCarContinuous-v0")
    return task, task.default_params.replace(
        max_episode_steps=8, start_low=0.35, start_high=0.44, power=0.004
    )


def both(mode):
    task, params = short_cars()
    ours = envs.to_gymnasium_vector(task, COUNT, params, autoreset_mode=mode)
    singles = [lambda: envs.to_gymnasium(task, params)] * COUNT
    return ours, SyncVectorEnv(singles, autoreset_mode=mode)


def assert_same(found, expected):
    """Arrays, and dictionaries of them, with the same values and the same `None`s."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for name in expected:
            assert_same(found[name], expected[name])
    elif expected.dtype == np.dtype(object):
        assert [x is None for x in found] == [x is None for x in expected]
        for x, y in zip(found, expected, strict=True):
            if y is not None:
                assert_same(x, y)
    else:
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_it_gives_what_gymnasiums_vector_of_single_tasks_gives(mode):
    ours, theirs = both(mode)
    assert ours.metadata["autoreset_mode"] is mode
    for name in ("observation_space", "action_space", "single_action_space", "num_envs"):
        assert getattr(ours, name) == getattr(theirs, name)
    generator, ends = np.random.default_rng(0), np.zeros(2, int)
    assert_same(ours.reset(seed=4)[0], theirs.reset(seed=4)[0])
    for _ in range(60):
        actions = generator.uniform(0.0, 1.0, (COUNT, 1)).astype(np.float32)
        mine, yours = ours.step(actions), theirs.step(actions)
        for found, expected in zip(mine, yours, strict=True):
            assert_same(found, expected)
        terminated, truncated = mine[2:4]
        ends += [terminated.sum(), truncated.sum()]
        ended = terminated | truncated
        if mode is AutoresetMode.DISABLED and ended.any():
            seeds = [11, None, 13]
            options = [{"reset_mask": ended.copy()} for _ in range(2)]
            found, expected = (
                vector.reset(seed=seeds, options=given)[0]
                for vector, given in zip((ours, theirs), options, strict=True)
            )
            assert_same(found, expected)
    assert (ends > 0).all()


def test_what_has_ended_is_not_stepped_where_nobody_resets_it():
    task, params = short_cars()
    vector = envs.to_gymnasium_vector(
        task, 2, params.replace(max_episode_steps=1), autoreset_mode="Disabled"
    )
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
        vector.step(np.zeros((2, 1)))
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before render"):
        vector.render()
    vector.reset(seed=0)
    vector.step(np.zeros((2, 1)))
    vector.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"sub-environments \[1\] have ended"):
        vector.step(np.zeros((2, 1)))
    with pytest.raises(ValueError, match="seed: 3 seeds for 2 sub-environments"):
        vector.reset(seed=[1, 2, 3])
    for mask in ([True, False], np.array([1, 0]), np.array([True])):
        with pytest.raises(ValueError, match="reset_mask: expected a numpy array of 2 bools"):
            vector.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match="reset_mask: it names no sub-environment"):
        vector.reset(options={"reset_mask": np.zeros(2, bool)})
    with pytest.raises(ValueError, match="a window shows one episode"):
        envs.to_gymnasium_vector(task, 2, render_mode="human")
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        envs.to_gymnasium_vector(task, 0)
    with pytest.raises(ValueError, match="'Sometimes' is not a valid AutoresetMode"):
        envs.to_gymnasium_vector(task, 1, autoreset_mode="Sometimes")


def test_a_seed_decides_all_episodes_and_no_seed_is_another():
    vector, _ = both("NextStep")
    runs = []
    for seed in (3, None, 3):
        first, _ = vector.reset(seed=seed)
        steps = [vector.step(np.ones((COUNT, 1)))[0] for _ in range(9)]
        runs.append(np.stack([first, *steps]))
    np.testing.assert_array_equal(runs[0], runs[2])
    assert (runs[0] != runs[1]).any()
    fresh, _ = both("NextStep")
    assert (fresh.reset()[0] != runs[0][0]).any()


def test_without_a_time_limit_it_goes_on():
    for limit in (-1, None):
        kwargs = {} if limit is None else {"max_episode_steps": limit}
        vector = gymnasium.make_vec("cmedirl_jax/Pendulum-v1", num_envs=1, **kwargs)
        vector.reset(seed=3)
        assert vector.np_random_seed == 3
        flags = [vector.step(np.zeros((1, 1), np.float32))[3][0] for _ in range(250)]
        assert flags.index(True) == 199 if limit is None else not any(flags)


@pytest.mark.parametrize("mode", MODES[:2])
def test_gymnasium_makes_it_and_its_wrappers_take_it(mode):
    vector = RecordEpisodeStatistics(
        gymnasium.make_vec(
            "cmedirl_jax/Pendulum-v1", num_envs=4, max_episode_steps=5, autoreset_mode=mode
        )
    )
    vector.reset(seed=0)
    returns = np.zeros(4)
    for _ in range(5):
        _, rewards, _, truncated, infos = vector.step(np.zeros((4, 1), np.float32))
        returns += rewards
    assert truncated.all()
    np.testing.assert_allclose(infos["episode"]["r"], returns, rtol=1e-5)


def test_a_frame_of_each(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    vector = gymnasium.make_vec("cmedirl_jax/Pendulum-v1", num_envs=2, render_mode="rgb_array")
    vector.reset(seed=1)
    single = gymnasium.make("cmedirl_jax/Pendulum-v1", render_mode="rgb_array")
    frames = vector.render()
    for index in range(2):
        single.reset(seed=1 + index)
        np.testing.assert_array_equal(frames[index], single.render())
    vector.step(np.ones((2, 1), np.float32))
    assert vector.render()[0].shape == frames[0].shape
    vector.close()
    single.close()
