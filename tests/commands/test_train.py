"""The tutorial: a run on demonstrations of others by the installed command."""

import dataclasses
import json
import re
import subprocess
import sys

import numpy as np
import polars as pl
import pytest

from cmedirl_jax.commands import train
from cmedirl_jax.commands.cmedirl import main
from cmedirl_jax.io import export
from cmedirl_jax.runs import load_policy, load_reward
from cmedirl_jax.training import tasks
from tests.support import ROOT

DEMOS = ("--env", "Pendulum-v1", "--demos", "mine/pendulum/energy-v0")
SMALL = (
    *("--seeds", "2", "--max-steps", "240", "--evaluation-starts", "2", "--devices", "1"),
    *("--architecture.hidden", "16", "--reward-network.hidden", "8", "--hot-start.steps", "20"),
    *("--architecture.critic-normalisation", "none", "--evaluate-every", "120"),
)
PICTURES = ("slices", "agreement", "retraining")
"""Of a task of three observations, which has no map."""
COLLECT, REWARD = re.findall(r"```py\n(.*?)```", (ROOT / "docs/tutorial.md").read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run, in the current folder of the command."""
    pytest.importorskip("minari")
    folder = tmp_path_factory.mktemp("train")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "datasets"))
        patch.setattr("cmedirl_jax.runs.train.FRESH_STARTS", 2)
        # In a process of its own: Minari leaves temporary folders to the collector of garbage.
        script = COLLECT.replace("range(40)", "range(3)")
        subprocess.run([sys.executable, "-c", script], check=True)
        assert main(["train", *DEMOS, *SMALL]) == 0
        yield folder / "results" / "Pendulum-v1"


def test_it_leaves_a_report_without_the_papers_claims(run):
    there = {path.name for path in run.iterdir() if not path.name.startswith(".")}
    assert {"summary.csv", "report.html", "figures", "cells", "evaluations.parquet"} <= there
    assert "claims.md" not in there
    page = (run / "report.html").read_text()
    assert "claims" not in page
    assert "Pendulum-v1: hs-me-ddpg" in page
    assert "demonstrations: mine/pendulum/energy-v0" in page
    # Three demonstrations are all there are.
    assert json.loads((run / "config.json").read_text())["config"]["n_demos"] == [3]


def test_the_tutorials_last_program_prints_the_reward(run, capsys):
    exec(compile(REWARD, "reward.py", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("angle speed | policy")
    assert len(lines) == 6


def test_the_rewards_card_has_an_interval_for_each_measure(run, capsys):
    carried = run.parent / "carried"
    options = ("--export", str(carried), "--retrain", "248", "--licence", "CC0-1.0")
    assert main(["reward", str(run), *options]) == 0
    output = capsys.readouterr().out
    assert "auc: how often a demonstrated step is paid more" in output
    assert "-constant: 2 fresh agents, each under 1 physics" in output
    summary = pl.read_csv(run / "reward" / "summary.csv")
    measures = {"epic_uniform", "epic_visited", "dard_uniform", "dard_visited", "correlation"}
    # Every demonstration was the learners' to see, no end pays, and three observations are no grid.
    assert set(summary["measure"]) == measures | {"auc", "largest", "discrepancy", "wasserstein"}
    assert (summary["low"] <= summary["mean"]).all()
    assert (summary["mean"] <= summary["high"]).all()
    rows = pl.read_parquet(run / "reward" / "seeds.parquet")
    assert rows["seed"].to_list() == [0, 1]
    there = {path.name for path in (run / "reward").iterdir()}
    pictures = {f"{name}.{kind}" for name in PICTURES for kind in ("png", "svg")}
    tables = {"summary.csv", "importance.csv", "diagnostics.csv", "retraining.csv"}
    tables |= {"seeds.parquet", "diagnostics.parquet", "retraining.parquet"}
    assert there == pictures | tables | {"report.html"}
    page = (run / "reward" / "report.html").read_text()
    assert page.count("<img") == len(PICTURES)
    importance = pl.read_csv(run / "reward" / "importance.csv")
    assert set(importance["measure"]) == {*(f"observation[{i}]" for i in range(3)), "action[0]"}
    fresh = pl.read_csv(run / "reward" / "retraining.csv")
    assert set(fresh["method"]) == {"r_e", "random", "+constant", "-constant", "hs-me-ddpg"}
    assert set(fresh["seeds"]) == {2}
    agents = pl.read_parquet(run / "reward" / "retraining.parquet")
    last = agents.filter(pl.col("env_step") == 248)
    # Agents begin alike, and part with their rewards.
    assert agents.filter(pl.col("env_step") == 0)["return_mean"].n_unique() == 2
    assert last["return_mean"].n_unique() == last.height
    # What was carried away is what the run holds.
    exported = export.load(carried)
    observation, action = np.zeros((4, 3), np.float32), np.full((4, 1), 0.5, np.float32)
    reward = load_reward(run, "hs-me-ddpg", 0)(observation, action)
    np.testing.assert_allclose(exported.functions["reward"](observation, action), reward, atol=1e-6)
    policy = load_policy(run, "hs-me-ddpg", 0)(observation)
    np.testing.assert_allclose(exported.functions["policy"](observation), policy, atol=1e-6)
    card = exported.card
    assert (card["task"], card["licence"], card["learner"]["seed"]) == ("Pendulum-v1", "CC0-1.0", 0)
    assert card["report_card"]["auc"] == rows["auc"][0]
    assert card["action"] == {"low": [-2.0], "high": [2.0]}


def test_exports_that_cannot_be_are_refused_before_the_work(run, capsys):
    def refused(*options):
        assert main(["reward", str(run), *options]) == 2
        return capsys.readouterr().err

    assert f"--export: {run} exists; take another" in refused("--export", str(run))
    assert "holds no method hs-me-ddpg, seed 9" in refused("--export", "new", "--seed", "9")
    assert "--physics: says under what to retrain" in refused("--physics", "g=9.8")
    assert "--licence: says what to export" in refused("--licence", "CC0-1.0")
    assert not (run.parent.parent / "new").exists()


def test_the_same_command_does_nothing_to_a_finished_run(run, capsys):
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()}
    assert main(["train", *DEMOS, *SMALL]) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert "[1/1]" not in capsys.readouterr().out
    assert main(["train", *DEMOS, *SMALL, "--agent.tau", "0.02"]) == 2
    assert "holds a run with --agent.tau 0.01, not 0.02" in capsys.readouterr().err


def test_a_second_method_joins_the_first_in_the_tables(run):
    options = train.Options(env="Pendulum-v1", methods=("ddpg", "hs-me-ddpg"), seeds=2)
    assert train.study(options).methods == ("hs-me-ddpg", "ddpg")
    # Elsewhere there is nothing yet.
    assert train.study(dataclasses.replace(options, out=run / "new")).methods == options.methods


def test_verdicts_of_another_command_do_not_stay_beside_its_report(run):
    (run / "claims.md").write_text("verdicts")
    assert main(["train", *DEMOS, *SMALL]) == 0
    assert not (run / "claims.md").exists()


def test_other_commands_find_the_only_method(run, capsys):
    assert main(["evaluate", str(run), "--starts", "2"]) == 0
    assert "hs-me-ddpg, seed 0: return -" in capsys.readouterr().out


def test_a_task_brings_its_settings_and_its_experts_and_options_come_first():
    options = train.default(["--env", "Pendulum-v1"])
    found = tasks.TASKS["Pendulum-v1"]
    assert (options.settings, options.max_steps) == (found.settings, found.steps)
    study = train.study(dataclasses.replace(options, env="PointMass-v0"))
    assert study.experts.settings == tasks.TASKS["PointMass-v0"].experts
    assert str(study.out) == "results/PointMass-v0"
    assert (
        str(train.study(train.Options(env="my.tasks:a/Dock-v0")).out)
        == "results/my.tasks-a-Dock-v0"
    )
