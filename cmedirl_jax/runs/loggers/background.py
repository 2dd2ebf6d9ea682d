"""A cell's log, written by a thread beside its training, which waits for nothing."""

import contextlib
import queue
import shutil
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cmedirl_jax.runs.cells.record import EvaluationRows
from cmedirl_jax.runs.console import streams
from cmedirl_jax.runs.loggers.base import Logger, Point, Writer
from cmedirl_jax.runs.loggers.registry import LOGGERS


class CellLog:
    """Logs a cell while it trains; leaving the context waits until everything is written.

    The log begins afresh whenever the cell's training is started, and a cell that goes on from a
    checkpoint brings the evaluations of before: a log shows no sign of where a run was stopped.
    A logger that fails is given up with a line on standard error.
    """

    def __init__(
        self,
        folder: Path,
        loggers: Sequence[str],
        seeds: range,
        *,
        each_seed: bool,
        experts: np.ndarray | None,
        config: Mapping[str, Any],
    ):
        """Log a cell in `folder`.

        Args:
            folder: `log/CELL`; what lies there is removed.
            loggers: their names; without any, nothing is done.
            seeds: the numbers of the cell's seeds in the study.
            each_seed: whether each seed is a series too, beside the means.
            experts: `[learners]`, who demonstrates to each seed of the study, as in
                `LearnersPool`; None: nobody.
            config: the run's, JSON values.
        """
        self._folder, self._seeds, self._each_seed = folder, seeds, each_seed
        experts = None if experts is None else experts[seeds.start : seeds.stop]
        self._experts = None if experts is None or (experts < 0).any() else experts
        self._outlets = [_Outlet(name, folder, config) for name in loggers]
        self._thread = threading.Thread(target=self._run, name=f"log of {folder.name}", daemon=True)
        self._evaluations: queue.SimpleQueue[EvaluationRows | None] = queue.SimpleQueue()
        self._followed = 0

    def __enter__(self) -> "CellLog":
        if self._outlets:
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._outlets:
            self._evaluations.put(None)
            # Whoever stops a run at once does not wait for a slow disk.
            at_once = kind is not None and issubclass(kind, KeyboardInterrupt)
            self._thread.join(1.0 if at_once else None)

    def follow(self, evaluations: Sequence[EvaluationRows]) -> None:
        """Log the evaluations that are new since the last call; returns at once.

        Args:
            evaluations: all that the cell has made so far, a list that only grows.
        """
        if self._outlets:
            for rows in evaluations[self._followed :]:
                self._evaluations.put(rows)
            self._followed = len(evaluations)

    def _run(self) -> None:
        """Remove the old log, and write the new one until the end."""
        # scipy takes a second to import, and the training need not wait for it.
        from cmedirl_jax.runs.loggers import points

        shutil.rmtree(self._folder, ignore_errors=True)
        ended = False
        while not ended:
            # Whatever waits is written at once: slow disks are given fewer, larger pieces.
            waiting = [self._evaluations.get()]
            while not self._evaluations.empty():
                waiting.append(self._evaluations.get())
            ended = waiting[-1] is None
            series: dict[str, list[Point]] = {}
            for rows in filter(None, waiting):
                found = points.of(rows, self._seeds, self._experts, each_seed=self._each_seed)
                for name, point in found.items():
                    series.setdefault(name, []).append(point)
            for outlet in self._outlets:
                outlet.write(series)
        for outlet in self._outlets:
            outlet.close()


class _Outlet:
    """A logger of a cell, and its writers by their series; after an error it does nothing."""

    def __init__(self, name: str, folder: Path, config: Mapping[str, Any]):
        self._name, self._folder, self._config = name, folder, config
        self._logger: Logger = LOGGERS[name]
        self._writers: dict[str, Writer] = {}
        self._failed = False

    def write(self, series: Mapping[str, Sequence[Point]]) -> None:
        if self._failed:
            return
        with self._without_failing():
            for name, points in series.items():
                if name not in self._writers:
                    self._writers[name] = self._logger.open(self._folder, name, self._config)
                self._writers[name].write(points)

    def close(self) -> None:
        # Those of a logger that failed hold files and processes too.
        for writer in self._writers.values():
            with self._without_failing():
                writer.close()

    @contextlib.contextmanager
    def _without_failing(self) -> Iterator[None]:
        try:
            yield
        # A package may raise anything, and the results do not depend on it.
        except Exception as error:
            if not self._failed:
                reason = " ".join(str(error).split()) or type(error).__name__
                streams.complain(
                    f"--log: {self._name} failed in {self._folder} ({reason}); "
                    "the run goes on without it"
                )
            self._failed = True
