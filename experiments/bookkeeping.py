"""The host's record of a cell in training: who runs, what was evaluated, which episodes ended."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from cmedirl_jax.evaluation import Evaluation
from cmedirl_jax.training import Log


@dataclasses.dataclass(frozen=True)
class Budget:
    """How long each seed trains, and when it is evaluated."""

    max_steps: int
    max_episodes: int | None
    evaluate_every: int
    evaluation_starts: int
    evaluate_every_episodes: int | None = None
    evaluation_starts_episodes: int = 100


class EvaluationRows(NamedTuple):
    """One evaluation of the seeds that were due, leaves `[seeds due]` (numpy).

    Attributes:
        protocol: "steps", or "episodes" for those made every so many episodes.
        seed: which seeds.
        env_step: steps each had learned from.
        episode: episodes each had finished.
        evaluation: what was found.
        q_mean: mean Q over the updates since the last evaluation; NaN before the first update.
        critic_loss: likewise.
    """

    protocol: str
    seed: np.ndarray
    env_step: np.ndarray
    episode: np.ndarray
    evaluation: Evaluation
    q_mean: np.ndarray
    critic_loss: np.ndarray


class EpisodeRows(NamedTuple):
    """Finished episodes, leaves `[episodes]` (numpy); `env_step` is the step each ended at."""

    seed: np.ndarray
    episode: np.ndarray
    env_step: np.ndarray
    episode_return: np.ndarray
    length: np.ndarray
    terminated: np.ndarray


class Book:
    """The record of `seeds_count` seeds; its arrays are `[seeds]`.

    Attributes:
        env_step: steps each seed has learned from.
        episode: episodes each has finished.
        running: neither out of episodes nor diverged.
        pending: has learned since its last evaluation by steps.
        diverged: stopped because a parameter was no longer finite.
        latest: mean return at the last evaluation by steps.
        evaluations: all of them, in the order they were made.
    """

    def __init__(self, seeds_count: int, budget: Budget):
        self.budget = budget
        self.env_step = np.zeros(seeds_count, np.int32)
        self.episode = np.zeros(seeds_count, np.int32)
        self.running = np.ones(seeds_count, bool)
        self.pending = np.zeros(seeds_count, bool)
        self.diverged = np.zeros(seeds_count, bool)
        self.latest = np.full(seeds_count, -np.inf)
        self.evaluations: list[EvaluationRows] = []
        self._episodes: list[EpisodeRows] = []
        self._episode_mark = np.zeros(seeds_count, np.int32)
        self._sums = np.zeros((3, seeds_count))

    def stepped(self, steps: np.ndarray, log: Log) -> None:
        """Record a chunk's episodes and update statistics."""
        count = self.env_step.size
        log = jax.tree.map(lambda leaf: leaf[:count], log)
        done = log.done & self.running[:, None]
        # Rows of np.nonzero are in order of seed, then of step.
        seed, at = np.nonzero(done)
        number = self.episode[:, None] + np.cumsum(done, axis=1)
        self._episodes.append(
            EpisodeRows(
                seed=seed,
                episode=number[seed, at],
                env_step=steps[at] + 1,
                episode_return=log.episode_return[seed, at],
                length=log.episode_length[seed, at],
                terminated=log.terminated[seed, at],
            )
        )
        self.episode = self.episode + done.sum(axis=1, dtype=np.int32)
        end = np.full(count, steps[-1] + 1, np.int32)
        if self.budget.max_episodes is not None:
            finished = self.running & (self.episode >= self.budget.max_episodes)
            last = done.shape[1] - 1 - np.argmax(done[:, ::-1], axis=1)
            end = np.where(finished, steps[last] + 1, end)
        else:
            finished = np.zeros(count, bool)
        active = (steps[None, :] < end[:, None]) & self.running[:, None] & log.learned
        q_mean, critic_loss = (np.where(active, x, 0.0) for x in (log.q_mean, log.critic_loss))
        self._sums += np.stack([active.sum(1), q_mean.sum(1), critic_loss.sum(1)])
        self.env_step = np.where(self.running, end, self.env_step)
        self.running &= ~finished

    def mark_diverged(self, finite: np.ndarray) -> None:
        """Stop the running seeds whose parameters are no longer finite."""
        self.diverged |= self.running & ~finite
        self.running &= finite

    def due_by_episodes(self) -> np.ndarray:
        """Which seeds have passed another multiple of `evaluate_every_episodes`."""
        every = self.budget.evaluate_every_episodes
        if every is None:
            return np.zeros(self.episode.size, bool)
        mark = self.episode // every
        due = mark > self._episode_mark
        self._episode_mark = mark
        return due

    def evaluated(self, protocol: str, due: np.ndarray, found: Evaluation) -> None:
        """Record an evaluation of the seeds `due`."""
        if not due.size:
            return
        found = jax.tree.map(lambda leaf: np.asarray(leaf)[due], found)
        updates, q_sum, loss_sum = self._sums[:, due]
        with np.errstate(invalid="ignore"):
            q_mean, critic_loss = q_sum / updates, loss_sum / updates
        self.evaluations.append(
            EvaluationRows(
                protocol, due, self.env_step[due], self.episode[due], found, q_mean, critic_loss
            )
        )
        if protocol == "steps":
            self.latest[due] = found.return_mean
            self._sums[:, due] = 0.0

    def solved_fraction(self, threshold: float) -> float:
        """Share of all seeds whose latest evaluation reaches the threshold."""
        return float(np.mean(self.latest >= threshold))

    def episode_rows(self) -> EpisodeRows:
        """All episodes recorded."""
        if not self._episodes:
            return EpisodeRows(*(np.zeros(0, np.int32) for _ in EpisodeRows._fields))
        return EpisodeRows(
            *(np.concatenate(column) for column in zip(*self._episodes, strict=True))
        )
