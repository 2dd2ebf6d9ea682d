"""Demonstrations on the command line: looked at, converted, recorded, begun."""

import numpy as np
import polars as pl
import pytest

from cmedirl_jax.commands.cmedirl import main
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.formats import tables
from tests.support import pools

CAR = ["--env", pools.ENV.spec.id]


@pytest.fixture
def table(tmp_path):
    tables.write_table(tmp_path / "pool.csv", pools.scripted(3))
    return tmp_path / "pool.csv"


def test_inspect_counts_what_is_there_and_draws_it(table, tmp_path, capsys):
    picture = tmp_path / "pool.png"
    assert main(["demos", "inspect", str(table), *CAR, "--picture", str(picture)]) == 0
    output = capsys.readouterr().out
    pool = pools.scripted(3)
    assert f"3 episodes, {len(pool.episode)} steps; the task ended 3, something else 0" in output
    assert "Every step is one of MountainCarContinuous-v0" in output
    rows = {line.split()[0]: line.split()[1:] for line in output.splitlines() if line.split()}
    returns = demonstrations.returns(pool)
    assert float(rows["return"][2]) == pytest.approx(np.median(returns), rel=1e-3)
    assert rows["action[0]"][-3:] == ["-1", "to", "1"]
    assert picture.read_bytes()[1:4] == b"PNG"


def test_inspect_names_what_is_wrong_and_what_is_absent(table, tmp_path, capsys):
    wrong = pl.read_csv(table).with_columns(action_0=pl.lit(0.3))
    wrong.write_csv(table)
    assert main(["demos", "inspect", str(table), *CAR]) == 1
    assert "episode 0, step" in capsys.readouterr().out
    wrong.drop("reward").write_csv(table)
    assert main(["demos", "inspect", str(table), *CAR, "--picture", str(tmp_path / "x.gif")]) == 2
    assert main(["demos", "inspect", str(table), *CAR]) == 1
    output = capsys.readouterr().out
    assert "There are no rewards" in output
    assert "\nreturn" not in output


def test_convert_keeps_every_step_and_computes_what_is_missing(table, tmp_path, capsys):
    pl.read_csv(table).drop("reward", "next_observation_0", "next_observation_1").write_csv(table)
    for target in ("pool.npz", "pool.parquet"):
        assert main(["demos", "convert", str(table), str(tmp_path / target), *CAR]) == 0
        found = demonstrations.read(tmp_path / target, env=pools.ENV)
        np.testing.assert_allclose(
            found.transition.reward, pools.scripted(3).transition.reward, atol=1e-6
        )
    assert capsys.readouterr().out.count("3 episodes") == 2


def test_a_dataset_of_minaris_is_made_and_read(table, tmp_path, monkeypatch, capsys):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    with pytest.warns(UserWarning, match="is set to None"):
        assert main(["demos", "convert", str(table), "test/cars-v0", *CAR]) == 0
    assert minari.load_dataset("test/cars-v0").total_episodes == 3
    assert main(["demos", "inspect", "test/cars-v0", *CAR]) == 0
    assert main(["demos", "convert", str(table), "test/cars-v0", *CAR]) == 2
    assert "already exist" in capsys.readouterr().err


def push(observation):
    return pools.controller(observation)


def test_record_plays_a_function_from_seeded_starts(tmp_path, capsys):
    out = tmp_path / "pool.npz"
    policy = f"{__name__}:push"
    command = ["demos", "record", str(out), *CAR, "--policy", policy, "--episodes", "2"]
    assert main([*command, "--reset-seed", "5"]) == 0
    assert "2 episodes, returns 97." in capsys.readouterr().out
    pool = demonstrations.load(out, pools.ENV.spec)
    demonstrations.check(pool, pools.ENV)
    assert pool.metadata["seeds"] == [5, 6]
    assert pool.metadata["source"] == policy
    # On Gymnasium's own car the same function does the same.
    command[command.index(CAR[1])] = f"gymnasium:{CAR[1]}"
    assert main(command) == 0
    assert demonstrations.load(out).metadata["env"] == f"gymnasium:{CAR[1]}"


def test_record_plays_what_a_run_has_learned(untrained_run, tmp_path):
    out = tmp_path / "pool.csv"
    of_run = ["--run", str(untrained_run), "--method", "ddpg", "--seed", "1", "--episodes", "1"]
    assert main(["demos", "record", str(out), *of_run]) == 0
    pool = demonstrations.read(out, env=pools.ENV)
    assert len(pool.episode) == 999
    assert pool.truncated[-1]


def test_a_template_is_read_and_never_written_over(tmp_path, capsys):
    out = tmp_path / "template.csv"
    assert main(["demos", "template", str(out), "--env", "PointMass-v0"]) == 0
    assert pl.read_csv(out).width == 1 + 4 + 2 + 3 + 4
    assert main(["demos", "template", str(out), "--env", "PointMass-v0"]) == 2
    assert "is there already" in capsys.readouterr().err


def test_evaluate_gives_the_return_on_the_tasks_fixed_starts(untrained_run, capsys):
    command = ["evaluate", str(untrained_run), "--method", "ddpg", "--seed", "0", "--starts", "3"]
    assert main(command) == 0
    output = capsys.readouterr().out
    assert "over 3 starts; 999 steps; the task ended 0% of the episodes" in output
