"""`run_grid --log`: what lies in a run's folder while it trains and afterwards."""

import json
import signal

import jax
import numpy as np
import polars as pl
import pytest

from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs import start
from cmedirl_jax.runs.cells import cell, compiled, tabular_cell
from cmedirl_jax.runs.cluster.base import ALONE
from cmedirl_jax.runs.loggers.background import CellLog
from cmedirl_jax.runs.storage import tables
from experiments import report, run_grid
from tests.support import logs, pools

SMALL = (
    *("--preset", "smoke", "--methods", "ddpg", "maxent-irl", "--seeds", 2, "--n-demos", 2),
    *("--max-steps", 100, "--evaluate-every", 25, "--schedule.learning-starts", 25),
    *("--schedule.batch-size", 4, "--architecture.hidden", 8),
    *("--tabular.states", 9, "--tabular.actions", 3, "--tabular.steps", 2, "--tabular.centres", 3),
)
SERIES = {"mean", "seed-0", "seed-1"}


@pytest.fixture
def main(tmp_path, monkeypatch):
    """The command on small cells and a device of this process, which draws no figures."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(start, "start", lambda *_: (ALONE, jax.devices()[:1]))
    monkeypatch.setattr(report, "report", lambda folder: None)
    monkeypatch.setattr(cell, "CHUNK", 25)
    # The runs of a test share what is compiled.
    for module, name in ((compiled, "compiler"), (tabular_cell, "compile_method")):
        monkeypatch.setattr(module, name, _once(getattr(module, name)))
    demonstrations.save(tmp_path / "pool.npz", pools.scripted(3))

    def run(*arguments):
        arguments = (*SMALL, "--demos", tmp_path / "pool.npz", *arguments)
        return run_grid.main([str(argument) for argument in arguments])

    return run


def _once(function):
    results = []

    def call(*arguments, **options):
        if not results:
            results.append(function(*arguments, **options))
        return results[0]

    return call


def csv_files(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.glob("log/*/csv/*")}


def test_a_run_that_was_stopped_and_goes_on_has_the_log_of_one_that_was_not(
    main, tmp_path, monkeypatch, capsys
):
    both = ("--log", "csv", "tensorboard", "--log-seeds")
    assert main("--out", "whole", *both) == 0

    def stopping(self, evaluations):
        follow(self, evaluations)
        if len(evaluations) == 3:
            signal.raise_signal(signal.SIGTERM)

    follow = CellLog.follow
    with monkeypatch.context() as patch:
        patch.setattr(CellLog, "follow", stopping)
        assert main("--out", "stopped", *both) == 143
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    (cut,) = stopped.glob("log/ddpg-seeds-0-1/csv/mean.csv")
    assert [row["step"] for row in logs.table(cut)] == ["0", "25", "50"]
    assert main("--out", "stopped", *both) == 0

    assert csv_files(stopped) == csv_files(whole)
    for name in ("ddpg-seeds-0-1", "maxent-irl-n2-seeds-0-1"):
        folders = [run / "log" / name / "tensorboard" for run in (whole, stopped)]
        assert {path.name for path in folders[0].iterdir()} == SERIES
        for series in SERIES:
            one, other = (logs.scalars(folder / series) for folder in folders)
            assert one == other
            assert one["return_mean"]
    _check_against_the_tables(whole)
    assert capsys.readouterr().err.splitlines() == [
        "run_grid: stopped by SIGTERM; start the same command again to go on"
    ]


def _check_against_the_tables(folder):
    config = json.loads((folder / "config.json").read_text())["config"]
    rows = tables.read(folder, config)["evaluations"].filter(pl.col("protocol") == "steps")
    for name, method in (("ddpg-seeds-0-1", "ddpg"), ("maxent-irl-n2-seeds-0-1", "maxent-irl")):
        of_cell = rows.filter(pl.col("method") == method)
        assert of_cell["env_step"].unique().sort().to_list() == (
            [0, 25, 50, 75, 100] if method == "ddpg" else [0]
        )
        means = of_cell.group_by("env_step").agg(pl.col("return_mean").cast(pl.Float64).mean())
        logged = logs.table(folder / "log" / name / "csv" / "mean.csv")
        np.testing.assert_allclose(
            [(float(row["step"]), float(row["return_mean"])) for row in logged],
            means.sort("env_step").to_numpy(),
        )
        for seed in range(2):
            own = of_cell.filter(pl.col("seed") == seed).select("env_step", "return_mean")
            logged = logs.table(folder / "log" / name / "csv" / f"seed-{seed}.csv")
            found = [(float(row["step"]), float(row["return_mean"])) for row in logged]
            np.testing.assert_array_equal(found, own.to_numpy())


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ("--log x", "--log: unknown logger 'x'; there are: csv, tensorboard, wandb"),
        ("--log csv csv", "--log: give each once"),
        ("--log-seeds", "--log-seeds: there is no --log"),
    ],
)
def test_logs_that_cannot_be_written_are_refused(main, tmp_path, capsys, options, line):
    assert main("--out", "run", *options.split()) == 2
    assert capsys.readouterr().err == f"run_grid: {line}\n"
    assert not (tmp_path / "run").exists()
