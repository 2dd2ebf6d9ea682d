"""The command on tasks without a threshold, and without a state in Gymnasium."""

import json

import numpy as np
import polars as pl
import pytest

from cmedirl_jax.runs import load_policy
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.training import tasks
from experiments import pooled, presets, run_grid

SMALL = [
    *("--preset", "smoke", "--seeds", "4", "--max-steps", "300", "--evaluate-every", "150"),
    *("--experts.steps", "1500", "--architecture.hidden", "16", "--reward-network.hidden", "8"),
    *("--experts.trajectories", "5", "--devices", "1"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "point"
    methods = ["--methods", "ddpg", "hs-me-ddpg"]
    # Experts who train as the learners do, in chunks of that size, share their program.
    settings = run_grid.parse(["--env", "PointMass-v0", *SMALL]).settings
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cell_lib, "CHUNK", 150)
        patch.setitem(tasks.TASKS, "PointMass-v0", tasks.TaskSettings(experts=settings))
        assert run_grid.main(["--env", "PointMass-v0", *SMALL, *methods, "--out", str(folder)]) == 0
        yield folder


def test_solved_is_on_the_way_from_random_actions_to_the_best_expert(run):
    found = json.loads((run / "config.json").read_text())["scale"]
    expected = found["random"] + 0.9 * (found["expert"] - found["random"])
    assert found["solved"] == pytest.approx(expected)
    assert found["random"] < found["solved"] < found["expert"]
    assert pooled.load(run).threshold == found["solved"]
    seeds = pl.read_parquet(run / "seeds.parquet")
    experts = seeds.filter(pl.col("method") == "hs-me-ddpg")["expert_return"]
    # The experts are those who solved the task so.
    assert experts.max() == pytest.approx(found["expert"], rel=1e-5)


def test_a_task_that_gymnasium_does_not_know_is_not_repeated_there(run):
    seeds = pl.read_parquet(run / "seeds.parquet")
    assert seeds["gymnasium_return"].null_count() == seeds.height
    assert pl.read_csv(run / "summary.csv")["gymnasium_difference_max"].null_count() == 2


def test_every_part_of_a_run_is_there(run):
    for name in ("report.html", "figures/figure3.png", "figures/survival.svg"):
        assert (run / name).is_file(), name
    # The paper's claims are about another task.
    assert not (run / "claims.md").exists()
    action = load_policy(run, "hs-me-ddpg", seed=3)(np.zeros(4, np.float32))
    assert action.shape == (2,)


def test_a_finished_run_goes_on_with_its_scale(run, capsys):
    before = (run / "config.json").read_bytes()
    methods = ["--methods", "ddpg", "hs-me-ddpg"]
    assert run_grid.main(["--env", "PointMass-v0", *SMALL, *methods, "--out", str(run)]) == 0
    assert (run / "config.json").read_bytes() == before


def test_without_a_threshold_and_experts_a_run_is_not_read(run, tmp_path):
    written = json.loads((run / "config.json").read_text())
    del written["scale"]
    with pytest.raises(UserError, match="its experts are not trained yet"):
        run_folder.solved(tmp_path, written)
    written["config"]["env"] = "MountainCarContinuous-v0"
    assert run_folder.solved(tmp_path, written) == 90.0


@pytest.mark.parametrize("scale", [{"solved": "high"}, {}, []])
def test_a_damaged_scale_is_a_users_error(run, tmp_path, scale):
    written = json.loads((run / "config.json").read_text()) | {"scale": scale}
    with pytest.raises(UserError, match="is not a readable configuration"):
        run_folder.solved(tmp_path, written)


def test_the_tuned_preset_of_a_task_has_what_works_there(monkeypatch):
    special = tasks.TaskSettings(steps=77, expert_steps=88)
    monkeypatch.setitem(tasks.TASKS, "PointMass-v0", special)
    config = run_grid.parse(["--env", "PointMass-v0"])
    assert (config.env, config.max_steps, config.experts.steps) == ("PointMass-v0", 77, 88)
    assert run_grid.parse(["--env", "PointMass-v0", "--max-steps", "9"]).max_steps == 9
    car = run_grid.parse([])
    assert car == presets.PRESETS["tuned"]
    paper = run_grid.parse(["--env", "PointMass-v0", "--preset", "paper"])
    assert paper.settings == presets.PRESETS["paper"].settings
    assert paper.env == "PointMass-v0"


def test_states_that_are_no_grid_of_few_dimensions_are_refused_with_their_size(tmp_path, capsys):
    options = ["--env", "PointMass-v0", "--methods", "maxent-irl", "--out", str(tmp_path / "x")]
    assert run_grid.main(options) == 2
    error = capsys.readouterr().err
    assert "--tabular: the dynamics [S, A, successors] would be" in error
    assert error.count("\n") == 1
