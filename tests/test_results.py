import dataclasses
import json
import math
from pathlib import Path

import jax
import polars as pl
import pytest
from hypothesis import given, settings
from polars.testing import assert_frame_equal

from cmedirl_jax.irl import IRLHParams
from cmedirl_jax.methods import Settings
from experiments import results
from experiments.errors import UserError
from experiments.presets import PRESETS, Grid
from tests import damages


@pytest.fixture
def grid(tmp_path):
    return Grid(out=tmp_path / "run")


def contents(folder):
    """Every file below `folder`, with its bytes."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def opened(grid):
    """Enter the run's folder and leave it; returns the folder."""
    with results.opened(grid) as folder:
        return folder


def cell(method, n_demos, episodes=3):
    """A finished cell's rows, of numbers that say nothing."""
    labels = pl.lit(method).alias("method"), pl.lit(n_demos).alias("n_demos")
    tables = {
        name: pl.DataFrame({key: [0.5, 1.5] for key in columns}).select(*labels, pl.all())
        for name, columns in results.COLUMNS.items()
    }
    return tables | {"episodes": tables["episodes"].head(episodes)}


def test_configuration_is_strict_json_with_versions(tmp_path):
    settings = dataclasses.replace(
        PRESETS["paper"].settings, reward=IRLHParams(gauge_rate=math.inf)
    )
    grid = dataclasses.replace(PRESETS["paper"], out=tmp_path, settings=settings)
    with results.opened(grid) as folder:
        text = (folder / "config.json").read_text()
    written = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert written["schema"] == results.SCHEMA
    assert written["versions"]["jax"] == jax.__version__
    assert written["config"]["n_demos"] == [200]
    assert written["config"]["settings"]["reward"]["gauge_rate"] == "inf"
    assert written["config"]["settings"]["hot_start"]["critic"] == "softmax"


@pytest.mark.parametrize("preset", PRESETS)
def test_the_same_configuration_enters_again_and_changes_nothing(preset, tmp_path):
    grid = dataclasses.replace(PRESETS[preset], out=tmp_path)
    opened(grid)
    before = contents(tmp_path)
    assert opened(grid) == tmp_path
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seeds": 3}, "--seeds 100, not 3;"),
        ({"n_demos": (1, 10)}, "--n-demos [200], not [1, 10];"),
        ({"max_steps": None, "max_episodes": 5}, "--max-episodes None, not 5;"),
        ({"demos": Path(__file__)}, f"--demos None, not {__file__};"),
        (
            {"settings": Settings(reward=IRLHParams(weight_limit=5.0))},
            "--reward.weight-limit None, not 5.0;",
        ),
    ],
)
def test_another_configuration_is_refused_naming_the_option_and_both_values(grid, change, named):
    folder = opened(grid)
    before = contents(folder)
    with pytest.raises(UserError) as error:
        opened(dataclasses.replace(grid, **change))
    assert str(error.value).startswith("--out: ")
    assert named in str(error.value)
    assert "\n" not in str(error.value)
    assert contents(folder) == before


def test_the_folders_spelling_and_the_devices_are_not_compared(grid, monkeypatch):
    folder = opened(grid)
    monkeypatch.chdir(folder.parent)
    respelled = dataclasses.replace(grid, out=Path(folder.name), devices=2)
    assert opened(respelled).samefile(folder)


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        b"{",
        b"\xff",
        b"[]",
        b"[" * 100_000,
        b'{"config": {}}',
        b'{"schema": 1}',
        b'{"schema": 1, "config": []}',
        b'{"schema": 2, "config": {}}',
    ],
)
def test_a_damaged_or_newer_configuration_is_refused_and_kept(grid, damaged):
    path = opened(grid) / "config.json"
    path.write_bytes(damaged)
    with pytest.raises(UserError, match=r"^--out: .*config\.json"):
        opened(grid)
    assert path.read_bytes() == damaged


@pytest.mark.parametrize("below", ["file", "file/run", "file/deep/run"])
def test_a_folder_that_cannot_be_made_is_refused(tmp_path, below):
    file = tmp_path / "file"
    file.write_text("kept")
    with pytest.raises(UserError, match=r"^--out: cannot write to "):
        opened(Grid(out=tmp_path / below))
    assert contents(tmp_path) == {file: b"kept"}


def test_replacing_moves_the_whole_file_into_place(tmp_path):
    path = tmp_path / "table"
    path.write_text("old")
    with results.replacing(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert contents(tmp_path) == {path: b"new"}


@pytest.mark.parametrize("before", [{}, {"table": b"old"}])
def test_replacing_leaves_things_as_they_were_after_an_error(tmp_path, before):
    before = {tmp_path / name: content for name, content in before.items()}
    for path, content in before.items():
        path.write_bytes(content)

    def write_half():
        with results.replacing(tmp_path / "table") as partial:
            partial.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert contents(tmp_path) == before


def test_an_empty_folder_has_no_finished_cells(tmp_path):
    assert results.finished(tmp_path) == set()
    assert results.read(tmp_path, "seeds") is None


def test_tables_hold_the_appended_cells_in_order(tmp_path):
    first, second = cell("ddpg", 0), cell("me-ddpg", 10)
    results.append(tmp_path, first)
    results.append(tmp_path, second)
    assert results.finished(tmp_path) == {("ddpg", 0), ("me-ddpg", 10)}
    for name in results.TABLES:
        assert_frame_equal(results.read(tmp_path, name), pl.concat([first[name], second[name]]))


def test_a_cell_in_which_no_episode_ended_is_finished(tmp_path):
    results.append(tmp_path, cell("ddpg", 0, episodes=0))
    assert results.finished(tmp_path) == {("ddpg", 0)}


@pytest.mark.parametrize("table", results.TABLES)
def test_a_cell_cut_off_before_its_last_table_does_not_count_and_can_be_added_again(
    tmp_path, monkeypatch, table
):
    first, second = cell("ddpg", 0), cell("me-ddpg", 10)
    results.append(tmp_path, first)
    replacing = results.replacing

    def cut_off(path):
        if path.name == f"{table}.parquet":
            raise KeyboardInterrupt
        return replacing(path)

    with monkeypatch.context() as patch:
        patch.setattr(results, "replacing", cut_off)
        with pytest.raises(KeyboardInterrupt):
            results.append(tmp_path, second)
    assert results.finished(tmp_path) == {("ddpg", 0)}
    for name in results.TABLES:
        assert_frame_equal(results.read(tmp_path, name), first[name])

    results.append(tmp_path, second)
    for name in results.TABLES:
        assert_frame_equal(results.read(tmp_path, name), pl.concat([first[name], second[name]]))


def test_a_first_cell_cut_off_before_its_last_table_leaves_no_finished_cell(tmp_path):
    for name, rows in cell("ddpg", 0).items():
        if name != "evaluations":
            rows.write_parquet(tmp_path / f"{name}.parquet")
    assert results.finished(tmp_path) == set()
    assert results.read(tmp_path, "seeds") is None


@pytest.mark.parametrize("table", results.TABLES)
@pytest.mark.parametrize("damage", ["empty", "garbage", "cut short", "foreign", "another's"])
def test_a_damaged_table_is_a_users_error(tmp_path, table, damage):
    results.append(tmp_path, cell("ddpg", 0))
    path = tmp_path / f"{table}.parquet"
    match damage:
        case "empty":
            path.write_bytes(b"")
        case "garbage":
            path.write_bytes(b"garbage" * 100)
        case "cut short":
            path.write_bytes(path.read_bytes()[:-20])
        case "foreign":
            pl.DataFrame({"another": [1]}).write_parquet(path)
        case "another's":
            pl.DataFrame({"method": ["ddpg"], "n_demos": [0]}).write_parquet(path)
    with pytest.raises(UserError, match=r"^--out: .*damaged table") as error:
        results.finished(tmp_path)
    assert "\n" not in str(error.value)


def test_a_missing_table_is_a_users_error(tmp_path):
    results.append(tmp_path, cell("ddpg", 0))
    (tmp_path / "seeds.parquet").unlink()
    with pytest.raises(UserError, match="damaged table"):
        results.finished(tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run's folder, and its configuration."""
    grid = Grid(out=tmp_path_factory.mktemp("whole"))
    with results.opened(grid) as folder:
        results.append(folder, cell("ddpg", 0))
    return grid


@settings(max_examples=100)
@given(damage=damages.damages())
def test_a_damaged_configuration_is_a_users_error_or_harmless(whole, damage):
    with damages.done_to(whole.folder / "config.json", damage):
        _, refusal = damages.attempt(UserError, results.check_folder, whole)
    assert refusal is None or refusal.startswith("--out: ")
    assert "\n" not in str(refusal)


@pytest.mark.parametrize("table", results.TABLES)
@settings(max_examples=60)
@given(damage=damages.damages())
def test_a_table_damaged_anywhere_is_a_users_error_or_read(whole, table, damage):
    with damages.done_to(whole.folder / f"{table}.parquet", damage):
        found, refusal = damages.attempt(UserError, results.finished, whole.folder)
    if refusal is None:
        assert all(isinstance(name, str | None) for name, _ in found)
    else:
        assert refusal.startswith("--out: ")
        assert "\n" not in refusal
