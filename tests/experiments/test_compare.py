import json
import math
import shutil

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings

from cmedirl_jax.runs import paired
from cmedirl_jax.runs.errors import UserError
from experiments import compare
from tests.support import damages
from tests.support.curves import SEEDS, save, write_config

CELLS = ("method", "n_demos", "against", "against_n_demos")


@pytest.fixture
def folder(tmp_path):
    """HS-DDPG reaches 90 a hundred steps before DDPG, but for a seed that never does."""
    write_config(tmp_path)
    slow, fast, never = [0, 20, 95], [10, 95, 95], [0, 0, 0]
    save(tmp_path, "ddpg", 0, [slow] * SEEDS)
    save(tmp_path, "hs-ddpg", 5, [*[fast] * (SEEDS - 1), never])
    save(tmp_path, "me-ddpg", 5, [slow] * SEEDS)
    save(tmp_path, "bc", 5, [[95]] * SEEDS)
    return tmp_path


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A run of two cells, which no test changes for the others."""
    folder = tmp_path_factory.mktemp("small")
    write_config(folder)
    for method, n_demos in (("ddpg", 0), ("hs-ddpg", 5)):
        save(folder, method, n_demos, [[0, 20, 95]] * SEEDS)
    return folder


def test_differences_are_of_pairs_of_seeds(folder):
    table = compare.compare([folder], "ddpg")
    assert table["method"].unique(maintain_order=True).to_list() == ["hs-ddpg", "me-ddpg"]
    found = {row["measure"]: row for row in table.filter(pl.col("method") == "hs-ddpg").to_dicts()}
    steps = np.array([-100.0] * (SEEDS - 1) + [0.0])  # Never counts as the last step.
    area = np.array([85 / 3] * (SEEDS - 1) + [-115 / 3])
    final = np.array([0.0] * (SEEDS - 1) + [-95.0])
    for name, expected in (
        ("convergence_env_step", steps),
        ("area", area),
        ("final_return", final),
    ):
        assert found[name]["difference"] == pytest.approx(expected.mean())
        assert found[name]["difference_low"] <= expected.mean() <= found[name]["difference_high"]
        assert found[name]["p_value"] == paired.p_value(expected, None)
    same = table.filter(pl.col("method") == "me-ddpg")
    assert same["difference"].to_list() == [0.0] * 4
    assert same["p_value"].to_list() == [1.0] * 4
    # Six pairs show nothing, however alike they are.
    assert same["equivalence"].to_list() == ["inconclusive"] * 4


def test_a_diverged_seed_stands_at_its_lowest_return(folder):
    save(folder, "hs-me-ddpg", 5, [*[[0, 20, 95]] * (SEEDS - 1), [30, 95]], diverged=[5])
    table = compare.compare([folder], "ddpg").filter(pl.col("method") == "hs-me-ddpg")
    difference = dict(table.select("measure", "difference").iter_rows())
    assert difference["final_return"] == pytest.approx((30 - 95) / SEEDS)
    assert difference["area"] == pytest.approx(((30 + 95 + 30) - 115) / 3 / SEEDS)


def test_cells_are_compared_at_their_own_number_of_demonstrations(folder):
    save(folder, "hs-ddpg", 7, [[0, 0, 95]] * SEEDS)
    save(folder, "me-ddpg", 7, [[0, 0, 95]] * SEEDS)
    table = compare.compare([folder], "hs-ddpg").filter(pl.col("measure") == "convergence_env_step")
    found = {tuple(row[:4]): row[4] for row in table.select(*CELLS, "difference").rows()}
    later = 100 * (SEEDS - 1) / SEEDS
    assert found == {
        ("me-ddpg", 5, "hs-ddpg", 5): pytest.approx(later),
        ("me-ddpg", 7, "hs-ddpg", 7): 0.0,
        # And each method with itself at the largest number.
        ("hs-ddpg", 5, "hs-ddpg", 7): pytest.approx(-later),
        ("me-ddpg", 5, "me-ddpg", 7): 0.0,
    }


@pytest.mark.parametrize(
    ("change", "named"),
    [({"max_episodes": 3, "max_steps": 200}, "whichever comes first"), ({"seeds": 1}, "one seed")],
)
def test_runs_without_paired_curves_are_refused(tmp_path, change, named):
    write_config(tmp_path)
    path = tmp_path / "config.json"
    written = json.loads(path.read_text())
    written["config"] |= change
    path.write_text(json.dumps(written))
    save(tmp_path, "ddpg", 0, [[0, 20, 95]] * change.get("seeds", SEEDS))
    with pytest.raises(UserError, match=named):
        compare.compare([tmp_path], "ddpg")


def test_the_command_prints_and_writes_the_table(folder, tmp_path, capsys):
    out = tmp_path / "new" / "differences.csv"
    assert compare.main([str(folder), "--against", "ddpg", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "mean paired differences" in shown
    assert "Left out, since they never act or ddpg has no one cell for them: bc (N_T 5)" in shown
    assert pl.read_csv(out).height == 2 * 4


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["nowhere"], "nowhere: holds no run"),
        (["{folder}", "--against", "gail"], "holds no 'gail'; its methods are ddpg, hs-ddpg, me-"),
        (["{folder}", "--against", "bc"], "holds no 'bc'"),
        (["{folder}", "--out", "{folder}"], "compare: --out: cannot write to "),
    ],
)
def test_mistakes_are_refused_in_a_line(folder, arguments, named, capsys):
    assert compare.main([argument.format(folder=folder) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1


CELL = "cells/ddpg-seeds-0-5"


@pytest.mark.parametrize(
    "name", ["config.json", f"{CELL}/evaluations.parquet", f"{CELL}/seeds.parquet"]
)
@settings(max_examples=50)
@given(damage=damages.damages())
def test_a_damaged_file_of_a_run_is_a_users_error_or_harmless(small, name, damage):
    with damages.done_to(small / name, damage):
        table, refusal = damages.attempt(UserError, compare.compare, [small], "ddpg")
    if refusal is not None:
        assert str(small) in refusal
        assert "\n" not in refusal
    else:
        assert set(table["measure"]) == {
            "area",
            "convergence_env_step",
            "final_return",
            "stayed_solved",
        }


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("config.json", b""),
        ("config.json", b"[" * 100_000),
        ("config.json", b'{"config": []}'),
        (
            "config.json",
            b'{"schema": 3, "versions": {}, "config": {"max_episodes": null, "seeds": "many"}}',
        ),
        (f"{CELL}/evaluations.parquet", b"PAR1"),
        (f"{CELL}/evaluations.parquet", pl.DataFrame({"another": [1]})),
        (f"{CELL}/evaluations.parquet", pl.DataFrame({"method": ["ddpg"], "n_demos": [0]})),
        (f"{CELL}/seeds.parquet", pl.DataFrame({"method": ["ddpg"], "n_demos": [0]})),
        (f"{CELL}/seeds.parquet", None),
    ],
)
def test_a_run_of_other_files_is_refused_in_a_line(small, name, content, capsys):
    path, whole = small / name, (small / name).read_bytes()
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is None:
        path.unlink()
    else:
        content.write_parquet(path)
    assert compare.main([str(small), "--against", "ddpg"]) == 2
    path.write_bytes(whole)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"compare: {small}")
    assert "damaged" in captured.err or "not a readable configuration" in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize("curves", [[[0, 1, 2]] * (SEEDS - 1), [[0, math.nan, 2]] * SEEDS])
def test_cells_of_fewer_seeds_or_undefined_returns_are_refused(small, curves):
    path = save(small, "me-ddpg", 5, curves)
    with pytest.raises(UserError, match=f"me-ddpg has no finite returns of {SEEDS} seeds"):
        compare.compare([small], "ddpg")
    shutil.rmtree(path)


def other_study(folder, seed=1, **changes):
    """Another study seed of the same configuration, whose HS-DDPG is as slow as DDPG."""
    write_config(folder, seed=seed, **changes)
    for method, n_demos in (("ddpg", 0), ("hs-ddpg", 5)):
        save(folder, method, n_demos, [[0, 20, 95]] * SEEDS)
    return folder


def test_studies_are_pooled_and_their_seeds_kept_apart(folder, tmp_path):
    other = other_study(tmp_path / "other")
    one, two, both = (
        compare.compare(folders, "ddpg").filter(
            pl.col("method") == "hs-ddpg", pl.col("measure") == "convergence_env_step"
        )
        for folders in ([folder], [other], [folder, other])
    )
    assert both["seeds"].item() == 2 * SEEDS
    expected = (one["difference"].item() + two["difference"].item()) / 2
    assert both["difference"].item() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"max_steps": 300}, "its max_steps is not that of"),
        ({"seed": 0}, "holds seeds of ddpg that another folder holds too"),
    ],
)
def test_runs_of_another_kind_or_of_the_same_seeds_are_not_pooled(folder, tmp_path, changes, named):
    other = other_study(tmp_path / "other", **changes)
    with pytest.raises(UserError, match=named):
        compare.compare([folder, other], "ddpg")
