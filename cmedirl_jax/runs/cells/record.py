"""The host's record of a cell in training: running seeds, evaluations, finished episodes."""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from cmedirl_jax.training import Log
from cmedirl_jax.training.evaluation import Evaluation
from cmedirl_jax.training.updates import Added


@dataclasses.dataclass(frozen=True)
class Budget:
    """How long each seed trains, and when it is evaluated."""

    max_steps: int
    max_episodes: int | None
    evaluate_every: int
    evaluation_starts: int
    evaluate_every_episodes: int | None = None
    evaluation_starts_episodes: int = 100


class Means(NamedTuple):
    """Means over the updates since the last evaluation by steps; NaN where there was none.

    Attributes:
        q_mean: Q(s, a) over the agent's minibatches.
        critic_loss: mean squared temporal-difference error.
        r_d_mean: what r_D adds to r_e over the agent's minibatches, or where r* is stored over the
            new transitions; all of r* for a method that learns from r_D alone.
        r_d_mean_square: likewise of its square.
        demonstration_reward: r_D over the reward learner's demonstrations.
        background_reward: r_D over its background.
        effective_sample_size: of its samples' weights.
    """

    q_mean: np.ndarray
    critic_loss: np.ndarray
    r_d_mean: np.ndarray
    r_d_mean_square: np.ndarray
    demonstration_reward: np.ndarray
    background_reward: np.ndarray
    effective_sample_size: np.ndarray


_OF_AGENT, _OF_ADDED, _OF_REWARD = Means._fields[:2], Means._fields[2:4], Means._fields[4:]
"""Which are of the log's own fields, of its `added` and of its `reward`."""


class EvaluationRows(NamedTuple):
    """One evaluation of the seeds that were due, leaves `[seeds due]` (numpy).

    Attributes:
        protocol: "steps", or "episodes" for those made every so many episodes.
        seed: which seeds.
        env_step: steps each had learned from.
        episode: episodes each had finished.
        evaluation: its statistics.
        means: diagnostics of the updates before it.
    """

    protocol: str
    seed: np.ndarray
    env_step: np.ndarray
    episode: np.ndarray
    evaluation: Evaluation
    means: Means


class EpisodeRows(NamedTuple):
    """Finished episodes, leaves `[episodes]` (numpy); `env_step` is the step each ended at."""

    seed: np.ndarray
    episode: np.ndarray
    env_step: np.ndarray
    episode_return: np.ndarray
    length: np.ndarray
    terminated: np.ndarray


_COLUMNS = (*EvaluationRows._fields[:4], *Evaluation._fields, *Means._fields)
"""The names of an evaluation's leaves in `Record.to_arrays`."""

_SEEDS = ("env_step", "episode", "running", "pending", "diverged", "latest", "_episode_mark")


class Record:
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
        self._sums = Means(*(np.zeros(seeds_count) for _ in Means._fields))
        self._updates = Means(*(np.zeros(seeds_count) for _ in Means._fields))

    def stepped(self, steps: np.ndarray, log: Log) -> None:
        """Record a chunk's episodes and update statistics."""
        count = self.env_step.size
        log = jax.tree.map(lambda leaf: leaf[:count], log)
        done = log.done & self.running[:, None]
        # The episodes that ended; np.nonzero orders them by seed, then by step.
        seed, at = np.nonzero(done)
        number = self.episode[:, None] + np.cumsum(done, axis=1)
        self._episodes.append(
            EpisodeRows(
                seed=seed,
                episode=number[seed, at],
                env_step=steps[at] + 1,
                episode_return=np.asarray(log.episode_return)[seed, at],
                length=np.asarray(log.episode_length)[seed, at],
                terminated=np.asarray(log.terminated)[seed, at],
            )
        )
        self.episode = self.episode + done.sum(axis=1, dtype=np.int32)
        # The step after which each seed learned no more.
        end = np.full(count, steps[-1] + 1, np.int32)
        if self.budget.max_episodes is not None:
            finished = self.running & (self.episode >= self.budget.max_episodes)
            last = done.shape[1] - 1 - np.argmax(done[:, ::-1], axis=1)
            end = np.where(finished, steps[last] + 1, end)
        else:
            finished = np.zeros(count, bool)
        # Sums over the updates until then.
        active = (steps[None, :] < end[:, None]) & self.running[:, None]
        learned, reward_learned = active & log.learned, active & log.reward_learned
        for source, names, fields, updated in (
            (log, _OF_AGENT, _OF_AGENT, learned),
            (log.added, _OF_ADDED, Added._fields, learned),
            (log.reward, _OF_REWARD, _OF_REWARD, reward_learned),
        ):
            for name, field in zip(names, fields, strict=True) if source is not None else ():
                values = np.where(updated, getattr(source, field), 0.0)
                getattr(self._sums, name)[:] += values.sum(axis=1)
                getattr(self._updates, name)[:] += updated.sum(axis=1)
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

    def evaluated(self, protocol: str, due: np.ndarray, evaluation: Evaluation) -> None:
        """Record the `evaluation` `[seeds]` of the seeds `due`."""
        if not due.size:
            return
        evaluation = jax.tree.map(lambda leaf: np.asarray(leaf)[due], evaluation)
        with np.errstate(invalid="ignore"):
            means = jax.tree.map(lambda total, n: total[due] / n[due], self._sums, self._updates)
        self.evaluations.append(
            EvaluationRows(protocol, due, self.env_step[due], self.episode[due], evaluation, means)
        )
        if protocol == "steps":
            self.latest[due] = evaluation.return_mean
            for totals in (*self._sums, *self._updates):
                totals[due] = 0.0

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

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The record as arrays by name, for `from_arrays`; copies."""
        # The evaluations' columns are laid end to end, the protocol as a column among them.
        leaves = [
            jax.tree.leaves(rows._replace(protocol=np.repeat(rows.protocol, len(rows.seed))))
            for rows in self.evaluations
        ]
        columns = [np.concatenate(parts) for parts in zip(*leaves, strict=True)]
        named = zip(_COLUMNS, columns, strict=True)
        arrays = {
            **{name: getattr(self, name) for name in _SEEDS},
            **{f"sums.{name}": column for name, column in self._sums._asdict().items()},
            **{f"updates.{name}": column for name, column in self._updates._asdict().items()},
            "evaluations": np.array([len(rows.seed) for rows in self.evaluations]),
            **{f"evaluations.{name}": column for name, column in named},
            **{f"episodes.{name}": x for name, x in self.episode_rows()._asdict().items()},
        }
        return {name: np.array(column) for name, column in arrays.items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], budget: Budget) -> "Record":
        """The record that `to_arrays` turned into these arrays."""
        record = cls(arrays["running"].size, budget)
        for name in _SEEDS:
            setattr(record, name, arrays[name])
        record._sums, record._updates = (
            Means(*(arrays[f"{kind}.{name}"] for name in Means._fields))
            for kind in ("sums", "updates")
        )
        ends = np.cumsum(arrays["evaluations"])
        for start, stop in zip(ends - arrays["evaluations"], ends, strict=True):
            columns: list[Any] = [arrays[f"evaluations.{name}"][start:stop] for name in _COLUMNS]
            protocol, seed, env_step, episode, *values = columns
            split = len(Evaluation._fields)
            record.evaluations.append(
                EvaluationRows(
                    str(protocol[0]),
                    seed,
                    env_step,
                    episode,
                    Evaluation(*values[:split]),
                    Means(*values[split:]),
                )
            )
        record._episodes = [EpisodeRows(*(arrays[f"episodes.{x}"] for x in EpisodeRows._fields))]
        return record
