"""A run on one's own demonstrations by the installed command."""

import dataclasses
import json

import numpy as np
import pytest

from cmedirl_jax.commands import train
from cmedirl_jax.commands.cmedirl import main
from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs import load_reward
from cmedirl_jax.training import tasks
from tests.support import pools

SMALL = (
    *("--method", "me-ddpg", "--seeds", "2", "--max-steps", "240", "--evaluation-starts", "2"),
    *("--architecture.hidden", "16", "16", "--devices", "1", "--evaluate-every", "120"),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run, in the current folder of the command."""
    folder = tmp_path_factory.mktemp("train")
    demonstrations.save(folder / "pool.npz", pools.scripted(3))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr("cmedirl_jax.runs.train.FRESH_STARTS", 2)
        assert main(["train", "--demos", "pool.npz", *SMALL]) == 0
    return folder / "results" / "MountainCarContinuous-v0"


def test_it_leaves_a_report_without_the_papers_claims_and_a_reward(run):
    there = {path.name for path in run.iterdir() if not path.name.startswith(".")}
    assert {"summary.csv", "report.html", "figures", "cells", "evaluations.parquet"} <= there
    assert "claims.md" not in there
    page = (run / "report.html").read_text()
    assert "claims" not in page
    assert "MountainCarContinuous-v0: me-ddpg" in page
    assert "demonstrations: pool.npz" in page
    observation, action = np.zeros(2, np.float32), np.zeros(1, np.float32)
    assert np.isfinite(load_reward(run, "me-ddpg", seed=1)(observation, action))
    # Three demonstrations are all there are.
    assert json.loads((run / "config.json").read_text())["config"]["n_demos"] == [3]


def test_the_same_command_does_nothing_to_a_finished_run(run, monkeypatch, capsys):
    monkeypatch.chdir(run.parents[1])
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()}
    assert main(["train", "--demos", "pool.npz", *SMALL]) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert "[1/1]" not in capsys.readouterr().out
    assert main(["train", "--demos", "pool.npz", *SMALL, "--agent.tau", "0.02"]) == 2
    assert "holds a run with --agent.tau 0.01, not 0.02" in capsys.readouterr().err


def test_a_second_method_joins_the_first_in_the_tables(run, monkeypatch, capsys):
    monkeypatch.chdir(run.parents[1])
    options = train.Options(methods=("ddpg", "me-ddpg"), seeds=2)
    assert train.study(options).methods == ("me-ddpg", "ddpg")
    # Elsewhere there is nothing yet.
    assert train.study(dataclasses.replace(options, out=run / "new")).methods == options.methods


def test_verdicts_of_another_command_do_not_stay_beside_its_report(run, monkeypatch):
    monkeypatch.chdir(run.parents[1])
    (run / "claims.md").write_text("verdicts")
    assert main(["train", "--demos", "pool.npz", *SMALL]) == 0
    assert not (run / "claims.md").exists()


def test_other_commands_find_the_only_method(run, capsys):
    assert main(["evaluate", str(run), "--starts", "2"]) == 0
    assert "over 2 starts" in capsys.readouterr().out


def test_a_task_brings_its_settings_and_its_experts_and_options_come_first():
    options = train.default(["--env", "Pendulum-v1"])
    found = tasks.TASKS["Pendulum-v1"]
    assert (options.settings, options.max_steps) == (found.settings, found.steps)
    study = train.study(options)
    assert study.experts.settings == found.experts
    assert str(study.out) == "results/Pendulum-v1"
    assert (
        str(train.study(train.Options(env="my.tasks:a/Dock-v0")).out)
        == "results/my.tasks-a-Dock-v0"
    )
