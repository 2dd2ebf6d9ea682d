import contextlib
import signal
import threading

import numpy as np
import pytest

from cmedirl_jax.runs import intervals
from cmedirl_jax.runs.errors import Interrupted
from cmedirl_jax.runs.loggers.background import CellLog
from cmedirl_jax.runs.loggers.base import Logger
from cmedirl_jax.runs.loggers.registry import LOGGERS
from tests.support import logs

EVALUATIONS = [logs.evaluation(step, [step, step + 1.0]) for step in (0, 50, 100, 150)]


class Faulty:
    """A logger whose methods raise where they are told to, and note what they were given."""

    def __init__(self, failing=()):
        self.failing, self.calls = failing, []

    def open(self, folder, series, config):
        self._do("open")
        return self

    def write(self, points):
        self._do("write", *(point.step for point in points))

    def close(self):
        self._do("close")

    def _do(self, *call):
        self.calls.append(call)
        if call[0] in self.failing:
            raise RuntimeError("no\nspace")


@pytest.fixture
def logger(monkeypatch):
    def add(writer):
        monkeypatch.setitem(LOGGERS, "mine", Logger(writer.open))
        return writer

    return add


def log(folder, *loggers, seeds=range(2), each_seed=False, experts=None):
    return CellLog(folder, loggers, seeds, each_seed=each_seed, experts=experts, config={})


def written(folder):
    return {path.name: path.read_bytes() for path in sorted((folder / "csv").iterdir())}


def test_every_evaluation_is_written_by_the_end(tmp_path):
    with log(tmp_path / "cell", "csv", each_seed=True) as following:
        for count in range(1, 5):
            following.follow(EVALUATIONS[:count])
            following.follow(EVALUATIONS[:count])
    assert list(written(tmp_path / "cell")) == ["mean.csv", "seed-0.csv", "seed-1.csv"]
    rows = logs.table(tmp_path / "cell" / "csv" / "mean.csv")
    assert [row["step"] for row in rows] == ["0", "50", "100", "150"]
    assert [float(row["return_mean"]) for row in rows] == [0.5, 50.5, 100.5, 150.5]


def test_a_log_begins_afresh_and_brings_the_evaluations_of_before(tmp_path):
    stopped, whole = tmp_path / "stopped", tmp_path / "whole"
    with contextlib.suppress(Interrupted), log(stopped, "csv", each_seed=True) as following:
        following.follow(EVALUATIONS[:2])
        raise Interrupted(signal.SIGTERM)
    assert len(logs.table(stopped / "csv" / "mean.csv")) == 2
    (stopped / "tensorboard").mkdir()
    for folder in (stopped, whole):
        with log(folder, "csv", each_seed=True) as following:
            following.follow(EVALUATIONS[:3])
            following.follow(EVALUATIONS)
    assert written(stopped) == written(whole)
    assert not (stopped / "tensorboard").exists()


def test_without_loggers_nothing_is_done(tmp_path):
    with log(tmp_path / "cell") as following:
        following.follow(EVALUATIONS)
    assert list(tmp_path.iterdir()) == []


def test_nobody_waits_for_a_slow_logger_until_the_end(tmp_path, logger):
    slow, may_open = logger(Faulty()), threading.Event()
    slow._do = lambda *call: may_open.wait() and slow.calls.append(call)
    with log(tmp_path / "cell", "mine") as following:
        following.follow(EVALUATIONS[:1])
        following.follow(EVALUATIONS)
        assert slow.calls == []
        may_open.set()
    steps = [step for call in slow.calls if call[0] == "write" for step in call[1:]]
    assert steps == [0, 50, 100, 150]
    assert slow.calls[-1] == ("close",)


@pytest.mark.parametrize("failing", ["open", "write", "close"])
def test_a_logger_that_fails_is_one_line_and_the_others_go_on(tmp_path, logger, capsys, failing):
    faulty = logger(Faulty((failing, "close")))
    with log(tmp_path / "cell", "mine", "csv") as following:
        following.follow(EVALUATIONS)
    line = f"--log: mine failed in {tmp_path / 'cell'} (no space); the run goes on without it\n"
    assert capsys.readouterr().err == line
    assert len(logs.table(tmp_path / "cell" / "csv" / "mean.csv")) == 4
    # What it holds is given back.
    assert (("close",) in faulty.calls) == (failing != "open")


def test_experts_are_those_of_the_cells_seeds(tmp_path):
    returns = np.array([1.0, 2.0, 6.0])
    rows = [logs.evaluation(0, returns)]
    for name, experts in {"shared": [0, 5, 5, 7], "none": [5, 5, -1, 7]}.items():
        folder = tmp_path / name
        with log(folder, "csv", seeds=range(1, 4), experts=np.array(experts)) as following:
            following.follow(rows)
        (row,) = logs.table(folder / "csv" / "mean.csv")
        clusters = np.array(experts[1:]) if name == "shared" else None
        bounds = intervals.mean(returns, clusters=clusters)[1:]
        assert (float(row["return_mean_low"]), float(row["return_mean_high"])) == bounds
