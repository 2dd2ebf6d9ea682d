import json
import os
import shutil
import subprocess
import sys

import jax
import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.formats import tables as tables_of_steps
from cmedirl_jax.io import checkpoint
from cmedirl_jax.runs import load_policy, load_reward, run, start, train, validation
from cmedirl_jax.runs.cells import experts
from cmedirl_jax.runs.cluster.base import ALONE
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.report import figures
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import tables
from cmedirl_jax.training import evaluation
from cmedirl_jax.training.methods import METHODS, PAPER_METHODS
from experiments import report, run_grid
from tests.support import ROOT, pools

SMOKE = ("--preset", "smoke")
START = start.start
TABLES = tables.FILES


def snapshot(folder):
    """Everything below `folder`: files with their bytes, folders with None."""
    paths = sorted(folder.rglob("*"))
    return {path: path.read_bytes() if path.is_file() else None for path in paths}


def run_command(*arguments, **environment):
    return subprocess.run(
        [sys.executable, "-m", "experiments.run_grid", *map(str, arguments)],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def main(tmp_path, monkeypatch):
    """The command in an empty working directory, on a device of this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(start, "start", lambda *_: (ALONE, jax.devices()[:1]))
    return lambda *arguments: run_grid.main([str(argument) for argument in arguments])


@pytest.fixture
def refused(main, tmp_path, capsys):
    """Run a command that must be refused; returns its one line without the program's name."""

    def run(*arguments):
        before = snapshot(tmp_path)
        assert main(*arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("run_grid: ")
        assert snapshot(tmp_path) == before
        return line.removeprefix("run_grid: ")

    return run


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            "--methods maxent-irl --tabular.states 1",
            "--tabular.states: must be at least 2, got 1",
        ),
        (
            "--methods maxent-irl --tabular.centres 1",
            "--tabular.centres: must be at least 2, got 1",
        ),
        (
            "--methods maxent-irl --tabular.states 9999",
            "--tabular: the dynamics [S, A, successors] would be 2.80e+9 numbers "
            "(10.4 GiB in float32), more than 2^28: take fewer states, actions or subsamples",
        ),
        (
            "--methods ddpg maxent-irl --tabular.centres 99",
            "--tabular: the reward's features [S, A, F] would be 3.46e+8 numbers "
            "(1.29 GiB in float32), more than 2^28: take fewer states, actions or centres",
        ),
        (
            "--methods deep-maxent-irl --tabular.hidden 64 99999",
            "--tabular: the reward's features [S, A, F] would be 1.18e+9 numbers "
            "(4.38 GiB in float32), more than 2^28: take fewer states, actions or hidden units",
        ),
        (
            "--methods me-ddpg --reward-network.kind radial-basis --reward-network.centres 1999",
            "--methods me-ddpg: radial basis functions would be 7.67e+8 numbers "
            "(2.86 GiB in float32), more than 2^28: take fewer centres",
        ),
        ("--tabular.steps 0", "--tabular.steps: must be at least 1, got 0"),
        (
            "--schedule.frozen-actor-steps -1",
            "--schedule.frozen-actor-steps: must be at least 0, got -1",
        ),
        (
            "--exploration.hot-start-factor 0",
            "--exploration.hot-start-factor: must be positive and finite, got 0.0",
        ),
        (
            "--exploration.kind epsilon-greedy --exploration.hot-start-factor 1.5",
            "--exploration.hot-start-factor: makes epsilon 1.5, above 1",
        ),
        ("--methods ddpg td3", f"--methods: unknown method 'td3'; there are {', '.join(METHODS)}"),
        ("--methods", "--methods: give one or more, each once"),
        ("--methods ddpg ddpg", "--methods: give one or more, each once"),
        ("--n-demos", "--n-demos: give one or more, each once"),
        ("--n-demos 5 5", "--n-demos: give one or more, each once"),
        (
            "--n-demos 200 --experts.trajectories 64",
            "--n-demos: 200 asked, the pool holds 64",
        ),
        (
            "--env Nothing-v0",
            "--env: unknown environment 'Nothing-v0'; there are: MountainCarContinuous-v0, "
            "Pendulum-v1, PointMass-v0, and Gymnasium's. "
            "Environment `Nothing` doesn't exist.",
        ),
        ("--agent.tau 0", "--agent.tau: must be above 0 and at most 1, got 0.0"),
        (
            "--reward.learning-rate nan",
            "--reward.learning-rate: must be at least 0 and finite, got nan",
        ),
        (
            "--methods me-ddpg --reward.objective trajectory --schedule.replay-capacity 9",
            "--methods me-ddpg: trajectories need a replay of 999 transitions: take a larger "
            "schedule.replay_capacity",
        ),
        ("--max-steps None", "--max-steps: give a number, or give --max-episodes"),
        ("--seed -1", "--seed: must be between 0 and 2^32 - 1, got -1"),
        (
            "--demos none.npz",
            "--demos: there is no file none.npz, nor a dataset of that name",
        ),
        (
            "--demos D4RL/door/human-v2",
            "--demos: Minari has no dataset D4RL/door/human-v2 here; fetch it by: minari download "
            "D4RL/door/human-v2",
        ),
        (
            f"--max-steps None --max-episodes {2**31 - 1}",
            f"--max-episodes: makes {999 * (2**31 - 1)} steps, more than 2^31 - 1",
        ),
    ],
)
def test_what_cannot_work_is_refused_in_a_line(refused, arguments, line):
    assert refused(*arguments.split()) == line


@pytest.mark.parametrize("size", [0, -3])
@pytest.mark.parametrize(
    "option",
    [
        "--n-demos",
        "--seeds",
        "--max-steps",
        "--max-episodes",
        "--evaluate-every",
        "--evaluation-starts",
        "--evaluate-every-episodes",
        "--devices",
        "--experts.seeds",
        "--experts.trajectories",
        "--schedule.batch-size",
        "--schedule.replay-capacity",
        "--reward-schedule.period",
        "--hot-start.cells",
        "--architecture.hidden",
        "--reward-network.hidden",
    ],
)
def test_sizes_must_be_positive(refused, option, size):
    assert refused(option, size) == f"{option}: must be at least 1, got {size}"


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        ("--architecture.action-layer 5", "--architecture"),
        (f"--seed {2**64}", "--seed"),
        (f"--out {'x' * 300}", "--out"),
    ],
)
def test_what_only_the_library_finds_is_refused_too(refused, arguments, option):
    assert refused("--methods", "ddpg", *arguments.split()).startswith(f"{option}: ")


def test_more_devices_than_there_are_are_refused(refused, monkeypatch):
    monkeypatch.setattr(start, "start", START)
    assert refused("--devices", 10**6, "--out", "run").startswith("--devices: 1000000 asked, there")


@pytest.fixture
def demos(tmp_path):
    """A demonstrations file of three episodes."""
    path = tmp_path / "demos.npz"
    demonstrations.save(path, pools.scripted(3))
    return path


def test_more_demonstrations_than_the_file_holds_are_refused(refused, demos):
    line = refused("--demos", demos, "--n-demos", 1, 4)
    assert line == "--n-demos: 4 asked, the pool holds 3"


def test_a_file_with_fewer_demonstrations_than_the_default_is_used_whole(
    main, demos, monkeypatch, capsys
):
    plans = []

    def stop(plan, *_):
        plans.append(plan)
        raise UserError("planned")

    monkeypatch.setattr(run, "run", stop)
    out = ("--out", "run")
    assert main("--demos", demos, *out) == 2
    assert capsys.readouterr() == (
        f"{demos}: each learner has all 3 demonstrations\n",
        "run_grid: planned\n",
    )
    # As if the number had been given.
    assert main("--demos", demos, "--n-demos", 3, *out) == 2
    whole, given = plans
    assert whole.asked == given.asked == [("ddpg", 0), *((m, 3) for m in PAPER_METHODS[1:])]
    assert (whole.config, whole.subset_size) == (given.config, 3)
    assert main("--demos", demos, "--n_demos=4", *out) == 2
    assert "--n-demos: 4 asked, the pool holds 3" in capsys.readouterr().err


@pytest.mark.parametrize(
    "damage",
    [
        "empty",
        "garbage",
        "cut short",
        "foreign",
        "pickle",
        "another environment",
        "undefined",
        "out of bounds",
        "folder",
        "pipe",
    ],
)
def test_a_demonstrations_file_that_cannot_be_used_is_refused(refused, demos, damage):
    match damage:
        case "empty":
            demos.write_bytes(b"")
        case "garbage":
            demos.write_bytes(b"garbage")
        case "cut short":
            demos.write_bytes(demos.read_bytes()[:-100])
        case "pickle":
            np.savez(demos, allow_pickle=True, header=np.array([{}], dtype=object))
        case "undefined" | "out of bounds":
            with np.load(demos) as file:
                arrays = dict(file)
            arrays["action"][5] = np.nan if damage == "undefined" else 2.0
            np.savez(demos, **arrays)
        case "folder" | "pipe":
            demos.unlink()
            (demos.mkdir if damage == "folder" else lambda: os.mkfifo(demos))()
        case "foreign":
            np.savez(demos, observation=np.zeros(3))
        case "another environment":
            pool = pools.scripted(3)._replace(metadata={"env": "Pendulum-v1"})
            demonstrations.save(demos, pool)
    assert refused("--demos", demos, "--n-demos", 1).startswith(f"--demos: {demos}: ")


@pytest.mark.slow
def test_demonstrations_of_any_format_are_those_of_our_own(main, demos, tmp_path):
    table = tmp_path / "pool.csv"
    tables_of_steps.write_table(table, pools.scripted(3))
    small = ["--methods", "bc", "--seeds", 2, "--hot-start.steps", 5, "--n-demos", 3]
    small += ["--architecture.hidden", 8]
    for number, source in enumerate((demos, table)):
        assert main(*SMOKE, *small, "--demos", source, "--out", tmp_path / f"run-{number}") == 0
    evaluations = [pl.read_parquet(tmp_path / f"run-{n}" / "evaluations.parquet") for n in (0, 1)]
    assert_frame_equal(*evaluations, rel_tol=1e-3, abs_tol=1e-3)


def test_demonstrations_without_actions_are_for_what_does_not_read_them(main, refused, tmp_path):
    table = tmp_path / "states.csv"
    tables_of_steps.write_table(table, pools.scripted(3))
    states = [f"{name}_{i}" for name in ("observation", "next_observation") for i in (0, 1)]
    pl.read_csv(table).select("episode", "terminated", "truncated", *states).write_csv(table)
    line = refused("--demos", table, "--n-demos", 3, "--methods", "hs-ddpg")
    assert line.startswith("--methods hs-ddpg: hs-ddpg starts hot from demonstrated actions")
    line = refused("--demos", table, "--n-demos", 3, "--methods", "me-ddpg")
    assert line.endswith("give reward_network.inputs state")
    small = ["--methods", "me-ddpg", "--reward-network.inputs", "state", "--seeds", 2]
    small += ["--max-steps", 250, "--architecture.hidden", 8, "--n-demos", 3]
    assert main(*SMOKE, *small, "--demos", table, "--out", tmp_path / "run") == 0
    scale = json.loads((tmp_path / "run" / "config.json").read_text())["scale"]
    assert scale["expert"] is None
    assert scale["reward_spread_demonstrated"] is None
    seeds = pl.read_parquet(tmp_path / "run" / "seeds.parquet")
    assert not seeds["diverged"].any()


@pytest.mark.parametrize(
    ("metadata", "named"),
    [
        ({"expert": {"name": "human"}}, "expert in its metadata is {'name': 'human'}"),
        ({"expert": None}, "expert in its metadata is None"),
        ({"expert_env_steps": "1e5"}, "expert_env_steps in its metadata is '1e5'"),
        ({"expert_env_steps": True}, "expert_env_steps in its metadata is True"),
        ({"expert_env_steps": -1}, "expert_env_steps in its metadata is -1"),
        ({"expert_env_steps": 2**63}, f"expert_env_steps in its metadata is {2**63}"),
    ],
)
def test_metadata_that_no_table_can_hold_is_refused(refused, tmp_path, metadata, named):
    pool = pools.scripted(5)
    demonstrations.save(tmp_path / "pool.npz", pool._replace(metadata=pool.metadata | metadata))
    assert named in refused(*SMOKE, "--demos", "pool.npz", "--out", "run")


SHORT_OF_MEMORY = (
    MemoryError(),
    jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: of no use"),
    jax.errors.JaxRuntimeError("INTERNAL: Out of memory allocating 9 bytes"),
)


@pytest.mark.parametrize("error", SHORT_OF_MEMORY)
def test_a_run_that_does_not_fit_in_memory_is_refused(refused, monkeypatch, error):
    def make_pool(*_):
        raise error

    monkeypatch.setattr(experts, "make_pool", make_pool)
    assert "memory is too small" in refused(*SMOKE, "--out", "run")


def test_a_run_that_runs_out_of_memory_keeps_its_checkpoints(main, monkeypatch, tmp_path, capsys):
    saved = tmp_path / "run" / "checkpoints" / "experts" / "250"

    def make_pool(*_):
        saved.mkdir(parents=True)
        raise MemoryError

    monkeypatch.setattr(experts, "make_pool", make_pool)
    assert main(*SMOKE, "--out", "run") == 1
    assert "Cannot allocate memory; what is finished is kept" in capsys.readouterr().err
    assert saved.exists()


@pytest.mark.parametrize("out", ["file", "file/run"])
def test_a_folder_that_cannot_be_made_is_refused(refused, tmp_path, out):
    (tmp_path / "file").touch()
    assert refused("--out", out).startswith(f"--out: cannot write to {out} (")


@pytest.mark.parametrize(
    ("option", "before", "now"), [("--seed", 0, 3), ("--agent.tau", 0.01, 0.5)]
)
def test_another_configuration_in_the_same_folder_is_refused(refused, option, before, now):
    arguments = (*SMOKE, "--out", "run")
    config = run_grid.parse(arguments)
    with run_folder.opened(config.folder, validation.describe(config)):
        (config.folder / "demonstrations").mkdir()
    line = refused(*arguments, option, now)
    assert line.startswith(f"--out: run holds a run with {option} {before}, not {now};")


@pytest.mark.parametrize(
    "out",
    [
        "run",
        "new/run",
        "old",
    ],
)
def test_a_run_without_an_able_expert_leaves_everything_as_it_was(
    refused, monkeypatch, tmp_path, out
):
    def make_pool(*_):
        raise UserError("--experts: none")

    monkeypatch.setattr(experts, "make_pool", make_pool)
    (tmp_path / "old").mkdir()
    assert refused(*SMOKE, "--out", out) == "--experts: none"


@pytest.fixture(scope="module")
def smoke(tmp_path_factory, compiled):
    """The folder and the output of a whole run."""
    folder = tmp_path_factory.mktemp("smoke") / "run"
    done = run_command(*SMOKE, "--out", folder, **compiled)
    assert done.returncode == 0, done.stderr
    return folder, done


CELLS = {("ddpg", 0): "ddpg-seeds-0-7"} | {
    (method, 5): f"{method}-n5-seeds-0-7" for method in ("hs-ddpg", "me-ddpg", "hs-me-ddpg")
}
SEEDS, STEPS = 8, (0, 250, 500)


def test_a_run_leaves_what_the_design_lists_and_nothing_unfinished(smoke):
    folder, done = smoke
    assert {path.name for path in folder.iterdir()} == {
        *(
            "config.json",
            "summary.csv",
            "claims.md",
            "report.html",
            "demonstrations",
            "cells",
            "figures",
        ),
        ".lock",
        *TABLES,
    }
    figures = {path.name: path.stat().st_size for path in (folder / "figures").iterdir()}
    names = ("figure3", "survival", "profile", "critic", "cost")
    assert figures.keys() == {f"{name}.{kind}" for name in names for kind in ("png", "svg")}
    assert all(figures.values())
    assert {path.name for path in (folder / "cells").iterdir()} == set(CELLS.values())
    for (method, _), name in CELLS.items():
        assert {path.name for path in (folder / "cells" / name).iterdir()} == {
            *("policies", "seal.json", *TABLES),
            *(("rewards",) if "me" in method else ()),
        }
    assert json.loads((folder / "config.json").read_text())["config"]["seeds"] == SEEDS
    assert "[1/5] experts" in done.stdout
    # Any array made before the devices are started would leave one.
    assert f"on {min(start.cores(), 2)} CPU device(s)" in done.stdout
    assert str(folder) in done.stdout


def test_a_run_evaluates_every_seed_of_every_cell_from_step_0_on(smoke):
    table = pl.read_parquet(smoke[0] / "evaluations.parquet")
    assert set(table.columns) >= {
        *("study", "expert", "method", "n_demos", "seed", "env_step", "episode"),
        *("return_mean", "return_std", "goal_fraction", "length_mean", "q_mean", "critic_loss"),
    }
    assert table.select("method", "n_demos", "seed", "env_step").rows() == [
        (*cell, seed, step) for cell in CELLS for seed in range(SEEDS) for step in STEPS
    ]
    losses = ("q_mean", "critic_loss")
    of_rewards = ("demonstration_reward", "background_reward", "effective_sample_size")
    added = ("r_d_mean", "r_d_std")
    assert table.drop(*losses, *added, *of_rewards).null_count().sum_horizontal().item() == 0
    learned = table.filter(
        pl.col("method").str.ends_with("me-ddpg"), pl.col("env_step") == STEPS[-1]
    )
    assert learned.select(of_rewards).null_count().sum_horizontal().item() == 0


def test_episodes_have_the_designed_columns_and_follow_each_other(smoke):
    table = pl.read_parquet(smoke[0] / "episodes.parquet")
    assert set(table.columns) >= {
        *("study", "expert", "method", "n_demos", "seed", "episode", "env_step"),
        *("return", "length", "terminated"),
    }
    assert set(table["method"]) >= {"hs-ddpg", "hs-me-ddpg"}
    assert table["env_step"].max() <= STEPS[-1]
    for learner in table.partition_by("method", "n_demos", "seed"):
        np.testing.assert_array_equal(learner["length"].cum_sum(), learner["env_step"])


def test_only_methods_that_use_demonstrations_name_an_expert(smoke):
    for name in TABLES:
        table = pl.read_parquet(smoke[0] / name)
        assert set(table.select("study", "method", "n_demos", "expert").unique().rows()) == {
            (0, method, n_demos, "each" if n_demos else "none") for method, n_demos in CELLS
        }


def test_demonstrations_are_a_valid_pool_of_the_size_asked(smoke, spec):
    pool = demonstrations.load(smoke[0] / "demonstrations" / "pool.npz", spec)
    able = pool.metadata["experts_demonstrating"]
    assert demonstrations.returns(pool).size == 64 * len(able)
    assert pool.metadata["expert"] == "each"
    seeds = pl.read_parquet(smoke[0] / "seeds.parquet").filter(pl.col("n_demos") > 0)
    # Each learner has its own expert, or the next one that solved the task.
    for seed, expert, score in seeds.select("seed", "expert_id", "expert_return").rows():
        expected = min((one for one in able if one >= seed), default=able[0])
        assert expert == expected
        assert score == pytest.approx(pool.metadata["expert_returns"][able.index(expert)])
    assert demonstrations.returns(pool).mean() > spec.reward_threshold


def test_the_summary_has_a_row_per_cell_and_counts_the_steps(smoke, spec):
    summary = pl.read_csv(smoke[0] / "summary.csv")
    assert summary.select("method", "n_demos").rows() == list(CELLS)
    assert summary["seeds"].to_list() == [SEEDS] * 4
    assert summary["diverged"].to_list() == [0] * 4
    assert summary["env_steps_learner"].to_list() == [SEEDS * STEPS[-1]] * 4
    able = summary["experts"][1]
    # Shared by those who solve the task, and counted once for each.
    assert summary["env_steps_expert"].to_list() == [0, *[able * (8 * 6_000 // able)] * 3]
    # The seeds of every method that uses demonstrations draw the same ones.
    without, *drawn = summary["env_steps_demonstrations"]
    assert without == 0
    assert len(set(drawn)) == 1
    pool = demonstrations.load(smoke[0] / "demonstrations" / "pool.npz", spec)
    length = demonstrations.episodes(pool).length
    assert 5 * SEEDS * length.min() <= drawn[0] <= 5 * SEEDS * length.max()


def test_policies_and_rewards_of_all_seeds_are_kept_and_agree_with_gymnasium(smoke):
    folder, _ = smoke
    for path in (*folder.glob("cells/*/policies"), *folder.glob("cells/*/rewards")):
        leaves = jax.tree.leaves(checkpoint.load(path))
        assert {leaf.shape[0] for leaf in leaves} == {SEEDS}
    seeds = pl.read_parquet(folder / "seeds.parquet")
    # Float32 may end an episode a step apart from Gymnasium's float64; which, the processor says.
    apart = seeds["gymnasium_difference"]
    assert (apart < 1e-3).mean() >= 0.9
    assert apart.max() < 0.05
    hot_started = seeds.filter(pl.col("method").str.starts_with("hs-"))
    assert hot_started["gymnasium_return"].min() > 80.0


def test_a_finished_run_is_left_alone(smoke, main, monkeypatch, capsys):
    folder, done = smoke
    before = snapshot(folder)
    times = {path: path.stat().st_mtime_ns for path in before if path.name != ".lock"}
    monkeypatch.setattr(train, "train_cells", lambda *_: pytest.fail("it trains again"))
    assert main(*SMOKE, "--out", folder) == 0
    assert snapshot(folder) == before
    assert {path: path.stat().st_mtime_ns for path in times} == times
    assert done.stdout.endswith(capsys.readouterr().out)


def test_fewer_cells_are_shown_without_training_and_all_again(smoke, main, monkeypatch, tmp_path):
    folder = shutil.copytree(smoke[0], tmp_path / "run")
    monkeypatch.setattr(train, "train_cells", lambda *_: pytest.fail("it trains again"))
    assert main(*SMOKE, "--methods", "me-ddpg", "ddpg", "--seeds", 3, "--out", folder) == 0
    table = pl.read_parquet(folder / "seeds.parquet")
    assert table.select("method", "seed").rows() == [
        (method, seed) for method in ("me-ddpg", "ddpg") for seed in range(3)
    ]
    assert pl.read_csv(folder / "summary.csv")["seeds"].to_list() == [3, 3]
    config = json.loads((folder / "config.json").read_text())["config"]
    assert (config["methods"], config["seeds"]) == (["me-ddpg", "ddpg"], 3)
    assert main(*SMOKE, "--out", folder) == 0
    for name in (*TABLES, "summary.csv", "config.json"):
        assert (folder / name).read_bytes() == (smoke[0] / name).read_bytes()


def test_more_numbers_and_seeds_train_what_is_missing(smoke, unoptimised, tmp_path):
    folder = shutil.copytree(smoke[0], tmp_path / "run")
    kept = snapshot(folder / "cells")
    more = ("--methods", "me-ddpg", "--n-demos", 5, 9, "--seeds", 9)
    done = run_command(*SMOKE, *more, "--out", folder, **unoptimised)
    assert done.returncode == 0, done.stderr
    titles = [line for line in done.stdout.splitlines() if line.startswith("[") and "%" not in line]
    assert titles == ["[1/2] me-ddpg-n5, seeds 8 to 8", "[2/2] me-ddpg-n9, 9 seeds"]
    assert snapshot(folder / "cells").items() >= kept.items()
    table = pl.read_parquet(folder / "seeds.parquet")
    assert table.select("method", "n_demos", "seed").rows() == [
        ("me-ddpg", n_demos, seed) for n_demos in (5, 9) for seed in range(9)
    ]


@pytest.mark.slow
def test_a_cell_depends_neither_on_the_cells_beside_it_nor_on_the_devices(
    smoke, unoptimised, tmp_path
):
    """Seeds 0 to 7 of `smoke` and 8 to 12 beside another cell, and all in a block on one device."""
    folder = shutil.copytree(smoke[0], tmp_path / "run")
    more = ("--methods", "ddpg", "me-ddpg", "--n-demos", 5, 9, "--seeds", 13)
    done = run_command(*SMOKE, *more, "--out", folder, **unoptimised)
    assert done.returncode == 0, done.stderr
    alone = tmp_path / "alone"
    pool = folder / "demonstrations" / "pool.npz"
    done = run_command(
        *(*SMOKE, "--methods", "me-ddpg", "--n-demos", 5, "--seeds", 13),
        *("--demos", pool, "--devices", 1, "--out", alone),
        **unoptimised,
    )
    assert done.returncode == 0, done.stderr
    assert "13 seeds per cell on 1 CPU device(s)" in done.stdout
    of_cell = (pl.col("method") == "me-ddpg") & (pl.col("n_demos") == 5)
    for name in TABLES:
        found = pl.read_parquet(folder / name).filter(of_cell)
        assert_frame_equal(found, pl.read_parquet(alone / name), rel_tol=1e-2, abs_tol=1e-2)


def test_figures_that_cannot_be_drawn_are_lines_and_the_results_stand(
    smoke, main, monkeypatch, tmp_path, capsys
):
    folder = shutil.copytree(smoke[0], tmp_path / "run")
    (folder / "summary.csv").write_bytes(b"another")
    # Two of the figures, for the time that drawing takes.
    every = figures.files
    monkeypatch.setattr(
        figures, "files", lambda *of: {name: every(*of)[name] for name in ("figure3", "cost")}
    )
    with monkeypatch.context() as patch:
        patch.setattr(figures, "average_return", lambda *_: 1 / 0)
        assert main(*SMOKE, "--out", folder) == 0
        output, errors = capsys.readouterr()
        assert smoke[1].stdout.endswith(output.replace(str(folder), str(smoke[0])))
        assert errors == (
            "run_grid: figure3.png is not drawn (ZeroDivisionError: division by zero); "
            "the results stand, and start the same command again to go on\n"
        )
        assert (folder / "summary.csv").read_bytes() == (smoke[0] / "summary.csv").read_bytes()
        # That of another summary is gone.
        assert not list((folder / "figures").glob("figure3.*"))
        assert report.main([str(folder)]) == 1
        line = "report: figure3.png is not drawn (ZeroDivisionError: division by zero)\n"
        assert capsys.readouterr().err == line
    assert main(*SMOKE, "--out", folder) == 0
    assert capsys.readouterr().err == ""
    drawn = list((folder / "figures").iterdir())
    assert len(drawn) == 4
    for path in drawn:
        assert (smoke[0] / "figures" / path.name).read_bytes() == path.read_bytes()


def test_a_report_makes_tables_and_figures_again_without_training(smoke, tmp_path, capsys):
    folder = shutil.copytree(smoke[0], tmp_path / "run")
    figures = snapshot(folder / "figures")
    for name in (*TABLES, "summary.csv"):
        (folder / name).write_bytes(b"damaged")
    (folder / "figures" / "figure3.png").unlink()
    assert report.main([str(folder)]) == 0
    assert capsys.readouterr().out == f"Tables and figures: {folder}\n"
    for name in (*TABLES, "summary.csv"):
        assert (folder / name).read_bytes() == (smoke[0] / name).read_bytes()
    assert snapshot(folder / "figures") == figures


def test_a_report_of_what_is_no_finished_run_is_refused(smoke, tmp_path, capsys):
    def refused(folder):
        assert report.main([str(folder)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert refused(tmp_path) == f"report: {tmp_path}: holds no run (there is no config.json)"
    shutil.copy(smoke[0] / "config.json", tmp_path)
    assert refused(tmp_path) == f"report: {tmp_path}: holds no finished cell of a run"
    folder = shutil.copytree(smoke[0], tmp_path / "run")
    with run_folder.held(folder):
        assert "another process is at work" in refused(folder)
    name = CELLS["ddpg", 0]
    (folder / "cells" / name / "seeds.parquet").unlink()
    assert f"{name} is damaged (seeds.parquet)" in refused(folder)


def test_policies_and_rewards_of_a_run_are_functions(smoke, env):
    """The best policy returns what its evaluations say."""
    folder, _ = smoke
    act = load_policy(folder, "hs-me-ddpg", seed=2)
    found = evaluation.evaluate(jax.jit(act), env, env.default_params, 10)
    table = pl.read_parquet(folder / "evaluations.parquet").filter(
        pl.col("method") == "hs-me-ddpg", pl.col("seed") == 2
    )
    assert float(found.return_mean) == pytest.approx(table["return_mean"].max(), abs=1e-3)
    observation, action = np.zeros((4, 2), np.float32), np.zeros((4, 1), np.float32)
    r_d = load_reward(folder, "hs-me-ddpg", seed=2)(observation, action)
    assert r_d.shape == (4,)
    assert (np.abs(r_d) <= 0.1).all()


def test_a_finished_run_refuses_another_configuration(smoke, main, capsys):
    before = snapshot(smoke[0])
    assert main(*SMOKE, "--out", smoke[0], "--expert", "median") == 2
    assert "--expert each, not median" in capsys.readouterr().err
    assert snapshot(smoke[0]) == before


def test_a_run_cut_off_between_cells_resumes_to_the_same_tables(smoke, compiled, tmp_path):
    last = CELLS["hs-me-ddpg", 5]
    folder = shutil.copytree(smoke[0], tmp_path / "run", ignore=shutil.ignore_patterns(last))
    for name in (*TABLES, "summary.csv"):
        (folder / name).unlink()

    done = run_command(*SMOKE, "--out", folder, **compiled)

    assert done.returncode == 0, done.stderr
    assert "[1/1] hs-me-ddpg-n5" in done.stdout
    for name in TABLES:
        assert_frame_equal(pl.read_parquet(folder / name), pl.read_parquet(smoke[0] / name))
    assert (folder / "summary.csv").read_bytes() == (smoke[0] / "summary.csv").read_bytes()


def test_methods_with_a_model_run_and_are_shown(unoptimised, demos, tmp_path):
    methods = ("tabular-me-ddpg", "maxent-irl", "deep-maxent-irl")
    tiny = {"states": 9, "actions": 3, "steps": 2, "centres": 3}
    folder = tmp_path / "run"
    done = run_command(
        *(*SMOKE, "--methods", *methods, "--n-demos", 1, 2, "--demos", demos),
        *("--seeds", 2, "--max-steps", 250, "--out", folder),
        *(part for name, value in tiny.items() for part in (f"--tabular.{name}", value)),
        **unoptimised,
    )
    assert done.returncode == 0, done.stderr
    summary = pl.read_csv(folder / "summary.csv")
    assert summary["method"].to_list() == [name for name in methods for _ in (1, 2)]
    acts = pl.col("method").str.ends_with("ddpg")
    modelled = summary.filter(~acts)
    for column in modelled.columns:
        if column.startswith(("converg", "sustained", "dip", "return_after")):
            assert modelled[column].null_count() == 4, column
    assert modelled["soft_return_mean"].null_count() == 0
    assert summary.filter(acts)["soft_return_mean"].null_count() == 2
    assert modelled["env_steps_learner"].to_list() == [0] * 4
    assert (modelled["gymnasium_difference_max"] < 0.05).all()
    evaluations = pl.read_parquet(folder / "evaluations.parquet").filter(~acts)
    assert evaluations.height == 4 * 2 * 2
    assert set(evaluations["protocol"]) == {"steps", "soft"}
    assert set(evaluations["env_step"]) == {0}
    for name in ("maxent-irl-n1", "deep-maxent-irl-n2", "tabular-me-ddpg-n2"):
        reward = checkpoint.load(folder / "cells" / f"{name}-seeds-0-1" / "rewards")
        assert reward.shape[0] == 2
        assert np.isfinite(reward).all()
    assert {"figure3.png", "figure4.png", "figure5.png"} <= {
        path.name for path in (folder / "figures").iterdir()
    }


@pytest.mark.slow
def test_comparators_and_controls_run_beside_the_others(unoptimised, demos, tmp_path):
    methods = ("bc", "gail", "ddpg-minus-constant", "random-reward")
    folder = tmp_path / "run"
    done = run_command(
        *(*SMOKE, "--methods", *methods, "--n-demos", 2, "--demos", demos),
        *("--seeds", 2, "--max-steps", 250, "--out", folder),
        *("--hot-start.steps", 5, "--gail.form", "logit D"),
        **unoptimised,
    )
    assert done.returncode == 0, done.stderr
    summary = pl.read_csv(folder / "summary.csv")
    assert summary["method"].to_list() == list(methods)
    assert summary["n_demos"].to_list() == [2, 2, 0, 0]
    assert summary["env_steps_learner"].to_list() == [0, 500, 500, 500]
    assert summary["converged_fraction"].null_count() == 1
    assert summary["diverged"].sum() == 0
    evaluations = pl.read_parquet(folder / "evaluations.parquet")
    assert evaluations.filter(pl.col("method") == "bc")["env_step"].to_list() == [0, 0]
    learned = evaluations.filter(pl.col("demonstration_reward").is_not_null())
    assert set(learned["method"]) == {"gail"}
    constant = checkpoint.load(folder / "cells/ddpg-minus-constant-seeds-0-1/rewards")
    np.testing.assert_allclose(constant, [-0.1, -0.1])
    assert {path.parent.name for path in folder.glob("cells/*/rewards")} == {
        "gail-n2-seeds-0-1",
        "ddpg-minus-constant-seeds-0-1",
        "random-reward-seeds-0-1",
    }
