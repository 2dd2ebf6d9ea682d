"""Episodes on the host: each sub-environment plays its own, in every autoreset mode."""

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import envs
from cmedirl_jax.envs import playing
from tests.support.host_tasks import Counting

MODES = list(AutoresetMode)


def vector_of(count, mode=AutoresetMode.DISABLED, **kwargs):
    return SyncVectorEnv([lambda: Counting(**kwargs)] * count, autoreset_mode=mode)


def episodes_of(vector, seeds, actions=lambda seen: np.zeros((len(seen), 1)), limit=99):
    """What `play` gave of each sub-environment's episodes: observations and last flags."""
    played = [[[] for _ in row] for row in seeds]
    for step in playing.play(vector, actions, np.asarray(seeds), limit):
        for index in np.flatnonzero(step.playing):
            played[index][step.episode[index]].append(
                (
                    step.observation[index].tolist(),
                    step.answer.observation[index].tolist(),
                    bool(step.answer.terminated[index]),
                    bool(step.truncated[index]),
                )
            )
    return played


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("truncates", [False, True])
@given(seeds=st.lists(st.lists(st.integers(0, 50), min_size=2, max_size=2), min_size=1, max_size=4))
def test_each_plays_the_episodes_of_its_seeds_to_their_true_ends(mode, truncates, seeds):
    played = episodes_of(vector_of(len(seeds), mode, truncates=truncates), seeds)
    for row, own in zip(seeds, played, strict=True):
        for seed, episode in zip(row, own, strict=True):
            length = 2 + seed % 3
            expected = [
                ([seed, t], [seed, t + 1], t + 1 == length and not truncates, False)
                for t in range(length)
            ]
            expected[-1] = (*expected[-1][:3], truncates)
            assert episode == expected


def test_a_limit_cuts_episodes_that_the_task_does_not():
    (own,) = episodes_of(vector_of(1), [[1, 0]], limit=2)
    assert [len(episode) for episode in own] == [2, 2]
    assert own[0][-1] == ([1, 1], [1, 2], False, True)
    # The other one ended by itself on the same step.
    assert own[1][-1] == ([0, 1], [0, 2], True, False)


def test_processes_of_their_own_give_the_same():
    starts = np.array([[3], [4]])
    ways = [
        envs.from_gymnasium("Pendulum-v1", asynchronous=way, max_episode_steps=5)
        for way in (False, True)
    ]
    results = []
    for task, kind in zip(ways, (SyncVectorEnv, AsyncVectorEnv), strict=True):
        vector = task.vector(2)
        assert type(vector) is kind
        results.append(episodes_of(vector, starts, lambda seen: seen[:, :1], 5))
        vector.close()
    assert results[0] == results[1]
