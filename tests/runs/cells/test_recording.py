import gymnasium
import jax
import numpy as np
import pytest

from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs.cells import recording
from tests.support.scripted import STRENGTHS, act

EPISODES = 4


@pytest.fixture(scope="module")
def pool(env):
    keys = list(jax.random.split(jax.random.key(3), STRENGTHS.size))
    return recording.record_all(act, env, STRENGTHS, keys, EPISODES, {"env": env.spec.id})


def gymnasium_episode(start, strength):
    """Return and length of the scripted policy's episode in Gymnasium."""
    environment = gymnasium.make("MountainCarContinuous-v0")
    environment.reset(seed=0)
    environment.unwrapped.state = observation = start
    total, length, done = 0.0, 0, False
    while not done:
        action = strength * np.where(observation[1:] >= 0, 1.0, -1.0)
        observation, reward, terminated, truncated, _ = environment.step(action)
        total, length, done = total + reward, length + 1, terminated or truncated
    environment.close()
    return total, length


def test_recorded_episodes_are_a_valid_pool(pool, spec):
    demonstrations.validate(pool, spec)
    assert {leaf.dtype for leaf in pool.transition} == {np.dtype("f4"), np.dtype("?")}


def test_recorded_episodes_are_gymnasiums(pool):
    start, length = demonstrations.episodes(pool)
    starts = np.float64(pool.transition.observation[start])
    strengths = np.repeat(STRENGTHS, EPISODES)
    found = [gymnasium_episode(*episode) for episode in zip(starts, strengths, strict=True)]
    returns, lengths = zip(*found, strict=True)
    np.testing.assert_array_equal(length, lengths)
    np.testing.assert_allclose(demonstrations.returns(pool), returns, atol=1e-4)
    assert pool.metadata["return_mean"] == pytest.approx(np.mean(returns))
    assert pool.metadata["return_std"] == pytest.approx(np.std(returns))


def test_episodes_start_at_different_places_and_last_differently(pool):
    start, length = demonstrations.episodes(pool)
    positions, velocities = pool.transition.observation[start].T
    assert np.unique(positions).size == STRENGTHS.size * EPISODES
    assert (np.abs(positions + 0.5) <= 0.1).all()
    assert (velocities == 0.0).all()
    assert np.unique(length[:EPISODES]).size > 1


def test_each_step_begins_where_the_one_before_ended(pool):
    same_episode = np.diff(pool.episode) == 0
    np.testing.assert_array_equal(
        pool.transition.observation[1:][same_episode],
        pool.transition.next_observation[:-1][same_episode],
    )


def test_episodes_end_at_the_goal_or_by_the_time_limit(pool, spec):
    start, length = demonstrations.episodes(pool)
    last = start + length - 1
    solved = np.repeat(STRENGTHS > 0, EPISODES)
    np.testing.assert_array_equal(pool.transition.terminated[last], solved)
    np.testing.assert_array_equal(pool.truncated[last], ~solved)
    assert (length[~solved] == spec.max_episode_steps).all()


def test_reaching_the_goal_at_the_last_step_is_no_truncation(env):
    start = -0.5
    _, limit = gymnasium_episode(np.array([start, 0.0]), STRENGTHS[0])
    params = env.default_params.replace(start_low=start, start_high=start, max_episode_steps=limit)
    spec = env.spec._replace(max_episode_steps=limit)
    short = env._replace(spec=spec, default_params=params)
    recorded = jax.jit(lambda key: recording.record(act, short, STRENGTHS[0], key, 1))
    transition, running, truncated = recorded(jax.random.key(0))
    assert running.all()
    assert transition.terminated[0, -1]
    assert not truncated.any()


def test_an_episode_that_the_task_does_not_end_is_truncated_at_the_specifications_limit(env):
    params = env.default_params.replace(max_episode_steps=10**6)
    endless = env._replace(
        spec=env.spec._replace(max_episode_steps=4), default_params=params, state_at=None
    )
    recorded = jax.jit(lambda key: recording.record(act, endless, STRENGTHS[1], key, 2))
    part = recording.flatten(*jax.tree.map(np.asarray, recorded(jax.random.key(0))))
    pool = recording.joined([part], {"env": env.spec.id})
    demonstrations.validate(pool, endless.spec)
    np.testing.assert_array_equal(pool.truncated, [False, False, False, True] * 2)
