"""Episodes of a task on the host, played side by side from given starts."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import VectorEnv

from cmedirl_jax.envs import stepping
from cmedirl_jax.envs.base import Step


class Played(NamedTuple):
    """One step of sub-environments that play episodes side by side, leaves `[n, ...]` numpy.

    Attributes:
        episode: which of its episodes each is in.
        playing: False for one that has played all of its episodes.
        observation: before the step.
        action: taken.
        answer: the task's.
        truncated: the episode ended here, and not by the task.
    """

    episode: np.ndarray
    playing: np.ndarray
    observation: np.ndarray
    action: np.ndarray
    answer: Step
    truncated: np.ndarray


def play(
    vector: VectorEnv,
    act: Callable[[np.ndarray], Any],
    seeds: np.ndarray,
    max_episode_steps: int,
) -> Iterator[Played]:
    """Play episodes, each sub-environment its own, one after the other, to the last one's end.

    Args:
        vector: the sub-environments.
        act: observations `[n, O]` -> actions `[n, A]`.
        seeds: `[n, E]`, of the starts of each one's episodes.
        max_episode_steps: steps after which an episode is cut.

    Raises:
        ValueError: as `stepping.restart`.
    """
    count, episodes = seeds.shape
    every, episode, length = np.arange(count), np.zeros(count, int), np.zeros(count, int)
    observation = stepping.reset(vector, seeds[:, 0])
    while (episode < episodes).any():
        action = np.asarray(act(observation))
        answer = stepping.step(vector, action)
        length += 1
        truncated = (answer.truncated | (length >= max_episode_steps)) & ~answer.terminated
        ended = answer.terminated | truncated
        playing = episode < episodes
        yield Played(episode, playing, observation, action, answer, truncated)
        episode = episode + (ended & playing)
        length[ended] = 0
        # One that has played all goes on with its last episode: the others need its steps.
        following = seeds[every, np.minimum(episode, episodes - 1)]
        observation = stepping.restart(vector, following, ended, answer.observation)
