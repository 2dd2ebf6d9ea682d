"""The command on somebody else's task of Gymnasium."""

import contextlib
import dataclasses
import io
import json
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from cmedirl_jax.runs import load_policy, load_reward, start, validation
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.training import tasks
from experiments import pooled, presets, run_grid

TASK = "tests.support.host_tasks:Dock-v0"
SMALL = [
    *("--env", TASK, "--preset", "smoke", "--seeds", "3", "--max-steps", "240"),
    *("--evaluate-every", "120", "--evaluation-starts", "2", "--experts.steps", "600"),
    *("--architecture.hidden", "16", "--reward-network.hidden", "8"),
    *("--experts.trajectories", "5", "--devices", "1"),
]
METHODS = ["--methods", "ddpg", "hs-me-ddpg"]


@pytest.fixture(scope="module", autouse=True)
def few_fresh_starts():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cmedirl_jax.runs.train.FRESH_STARTS", 5)
        patch.setattr("cmedirl_jax.runs.cells.experts.EVALUATION_STARTS", 5)
        yield


def test_a_further_device_is_for_more_learners_on_the_host_than_in_jax(monkeypatch):
    fewest = []

    def refuse(*arguments):
        fewest.append(arguments[-1])
        raise UserError("enough")

    monkeypatch.setattr(start, "start", refuse)
    for env in ("Pendulum-v1", "gymnasium:Pendulum-v1"):
        assert run_grid.main(["--env", env]) == 2
    assert fewest == [start.FEWEST, start.FEWEST_ON_HOST]


@pytest.fixture(scope="module")
def programs():
    """The compilers of `run`, which later runs of the same sizes need not make again."""
    return []


@pytest.fixture(scope="module")
def run(tmp_path_factory, programs):
    folder = tmp_path_factory.mktemp("runs") / "dock"
    compiler = compiled_lib.compiler

    def remembered(*arguments, **options):
        programs.append(compiler(*arguments, **options))
        return programs[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled_lib, "compiler", remembered)
        with contextlib.redirect_stdout(io.StringIO()) as said:
            assert run_grid.main([*SMALL, *METHODS, "--out", str(folder)]) == 0
    (folder.parent / "said.txt").write_text(said.getvalue())
    return folder


def test_every_part_of_a_run_is_there(run):
    for name in ("report.html", "figures/figure3.png", "figures/survival.svg"):
        assert (run / name).is_file(), name
    # The paper's claims are about another task.
    assert not (run / "claims.md").exists()
    observation = np.zeros(2, np.float32)
    action = load_policy(run, "hs-me-ddpg", seed=2)(observation)
    assert -0.5 <= action[0] <= 1.0
    assert np.isfinite(load_reward(run, "hs-me-ddpg", seed=2)(observation, action))
    evaluations = pl.read_parquet(run / "evaluations.parquet")
    assert evaluations["env_step"].unique().sort().to_list() == [0, 120, 240]
    assert evaluations["length_mean"].max() <= 60.0
    # Whole episodes of 60 steps, and none besides.
    episodes = pl.read_parquet(run / "episodes.parquet")
    assert episodes.filter(~pl.col("terminated"))["length"].unique().to_list() == [60]


def test_its_scale_is_measured_on_its_own_starts(run):
    scale = json.loads((run / "config.json").read_text())["scale"]
    assert scale["random"] < scale["solved"] < scale["expert"]
    assert scale["reward_spread_random"] > 0.0
    assert pooled.load(run).threshold == scale["solved"]


def test_a_run_that_was_cut_off_goes_on_at_the_start_of_an_episode(
    run, programs, tmp_path, monkeypatch, capsys
):
    """At step 90 of 240, within the second episode of 60 steps."""
    monkeypatch.setattr(cell_lib, "CHUNK", 90)
    monkeypatch.setattr(compiled_lib, "compiler", lambda *_, **__: programs[0])
    folder, advance = tmp_path / "run", cell_lib._Training.advance

    def killed(training, stop):
        if stop > 90 and training.record.budget.max_steps == 240:
            raise KeyboardInterrupt
        advance(training, stop)

    command = [*SMALL, "--methods", "ddpg", "--checkpoint-every", "0", "--out", str(folder)]
    command += ["--demos", str(run / "demonstrations" / "pool.npz")]
    with monkeypatch.context() as patch:
        patch.setattr(cell_lib._Training, "advance", killed)
        assert run_grid.main(command) == 130
    assert run_grid.main(command) == 0
    assert "goes on" in capsys.readouterr().out
    episodes = pl.read_parquet(folder / "episodes.parquet").sort("seed", "episode")
    for _, own in episodes.group_by("seed"):
        # The episode that was cut off at step 90 is in no table; the next begins there.
        lengths, ends = own["length"].to_list(), own["env_step"].to_list()
        assert (lengths[0], ends[0]) == (60, 60)
        assert ends[1] == 90 + lengths[1]
        assert max(lengths) <= 60
    evaluations = pl.read_parquet(folder / "evaluations.parquet")
    assert evaluations["env_step"].max() == 240


@pytest.mark.slow
def test_experts_that_all_share_are_more_than_the_learners(tmp_path):
    """On two devices, of which one has an idle slot."""
    small = [*SMALL[:-2], "--devices", "2", "--expert", "best", "--experts.seeds", "4"]
    folder = tmp_path / "run"
    assert run_grid.main([*small, "--methods", "bc", "--out", str(folder)]) == 0
    seeds = pl.read_parquet(folder / "seeds.parquet")
    assert seeds["seed"].to_list() == [0, 1, 2]
    assert seeds["expert_id"].n_unique() == 1


@pytest.mark.slow
def test_processes_of_their_own_change_no_number(run, tmp_path):
    folder = tmp_path / "run"
    command = [*SMALL, "--methods", "ddpg", "--out", str(folder), "--asynchronous"]
    pool = ["--demos", str(run / "demonstrations" / "pool.npz")]
    assert run_grid.main([*command, *pool]) == 0
    of_ddpg = pl.col("method") == "ddpg"
    for name in ("evaluations", "episodes"):
        expected = pl.read_parquet(run / f"{name}.parquet").filter(of_ddpg)
        found = pl.read_parquet(folder / f"{name}.parquet")
        assert_frame_equal(found, expected, rel_tol=1e-3, abs_tol=1e-3)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--env", "CartPole-v1"], r"--env: CartPole-v1: its actions are Discrete\(2\)"),
        (["--env", TASK, "--methods", "maxent-irl"], "maxent-irl: it needs a task in JAX"),
        (["--env", "Nothing-v0"], "--env: unknown environment 'Nothing-v0'"),
        (["--env", TASK, "--group", "2"], "--group: .*all seeds together"),
        (["--asynchronous"], "--asynchronous: MountainCarContinuous-v0 is a task in JAX"),
    ],
)
def test_what_the_host_cannot_do_is_refused(options, line, tmp_path, capsys):
    assert run_grid.main([*options, "--out", str(tmp_path / "x")]) == 2
    error = capsys.readouterr().err
    assert re.search(line, error)
    assert error.count("\n") == 1


def test_several_processes_are_refused():
    shared = dataclasses.replace(presets.preset("tuned", env=TASK), distributed=True)
    with pytest.raises(UserError, match=r"--processes: .* is stepped on one host, by one process"):
        validation.check(shared)


@pytest.mark.parametrize("name", [TASK, "Dock-v0"])
def test_a_tasks_settings_are_found_by_either_of_its_names(monkeypatch, name):
    monkeypatch.setitem(tasks.TASKS, name, tasks.TaskSettings(steps=77))
    config = presets.preset("tuned", env=TASK)
    assert config.max_steps == 77
    assert config.resolved_experts.settings == tasks.TaskSettings().experts
    written = {"config": {"env": TASK}, "scale": {"solved": 3}}
    assert run_folder.solved(Path("."), written) == 3.0


def test_settings_may_stand_in_the_tasks_own_module(monkeypatch):
    def imported(module):
        assert module == "mine"
        monkeypatch.setitem(tasks.TASKS, "Mine-v0", tasks.TaskSettings(steps=78))

    monkeypatch.setattr(tasks.importlib, "import_module", imported)
    assert presets.preset("tuned", env="mine:Mine-v0").max_steps == 78


def test_experts_of_a_task_without_settings_train_as_its_learners_do():
    config = run_grid.parse(["--env", TASK, "--agent.tau", "0.02"])
    assert config.resolved_experts.settings.agent.tau == 0.02
    known = run_grid.parse(["--env", "Pendulum-v1", "--agent.tau", "0.02"])
    assert known.resolved_experts.settings == tasks.of("Pendulum-v1").experts
    # The paper's learners do not learn: its experts are tuned.
    paper = run_grid.parse(["--env", TASK, "--preset", "paper"])
    assert paper.resolved_experts.settings == tasks.TaskSettings().experts


def test_what_the_run_says_of_its_settings_and_experts(run):
    output = " ".join((run.parent / "said.txt").read_text().split())
    assert "Dock-v0 has no settings of its own: the car's, see docs/tuning.md" in output
    assert re.search(r"\d of 3 experts solve the task; \d demonstrate for 3 learners", output)
    assert "No episode was repeated" not in output
