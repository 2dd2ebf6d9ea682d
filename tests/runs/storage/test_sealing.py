import io
from pathlib import Path

import polars as pl
import pytest
from hypothesis import given, settings
from polars.testing import assert_frame_equal

from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import sealing
from tests.support import damages


def contents(folder):
    """Every file below `folder`, with its bytes."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def cell(method, n_demos, episodes=3):
    """A finished cell's rows, of numbers that say nothing."""
    labels = {"method": method, "n_demos": n_demos}
    rows = pl.DataFrame({"seed": [0, 1], "return_mean": [0.5, 1.5]}).with_columns(
        *(pl.lit(value).alias(name) for name, value in labels.items())
    )
    return {"seeds": rows, "episodes": rows.head(episodes), "evaluations": rows}


def test_replacing_moves_the_whole_file_into_place(tmp_path):
    path = tmp_path / "table"
    path.write_text("old")
    with sealing.replacing(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert contents(tmp_path) == {path: b"new"}


@pytest.mark.parametrize("before", [{}, {"table": b"old"}])
def test_replacing_leaves_things_as_they_were_after_an_error(tmp_path, before):
    before = {tmp_path / name: content for name, content in before.items()}
    for path, content in before.items():
        path.write_bytes(content)

    def write_half():
        with sealing.replacing(tmp_path / "table") as partial:
            partial.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert contents(tmp_path) == before


def test_an_empty_folder_has_no_finished_cells(tmp_path):
    assert sealing.finished(tmp_path) == set()
    assert sealing.read(tmp_path) == {}


def test_tables_hold_the_appended_cells_in_order(tmp_path):
    first, second = cell("ddpg", 0), cell("me-ddpg", 10)
    sealing.append(tmp_path, first)
    sealing.append(tmp_path, second)
    assert sealing.finished(tmp_path) == {("ddpg", 0), ("me-ddpg", 10)}
    for name in sealing.TABLES:
        assert_frame_equal(sealing.read(tmp_path)[name], pl.concat([first[name], second[name]]))


def test_a_cell_in_which_no_episode_ended_is_finished(tmp_path):
    sealing.append(tmp_path, cell("ddpg", 0, episodes=0))
    assert sealing.finished(tmp_path) == {("ddpg", 0)}


@pytest.mark.parametrize("table", sealing.TABLES)
def test_a_cell_cut_off_before_its_last_table_does_not_count_and_can_be_added_again(
    tmp_path, monkeypatch, table
):
    first, second = cell("ddpg", 0), cell("me-ddpg", 10)
    sealing.append(tmp_path, first)
    replacing = sealing.replacing

    def cut_off(path):
        if path.name == f"{table}.parquet":
            raise KeyboardInterrupt
        return replacing(path)

    with monkeypatch.context() as patch:
        patch.setattr(sealing, "replacing", cut_off)
        with pytest.raises(KeyboardInterrupt):
            sealing.append(tmp_path, second)
    assert sealing.finished(tmp_path) == {("ddpg", 0)}
    for name in sealing.TABLES:
        assert_frame_equal(sealing.read(tmp_path)[name], first[name])

    sealing.append(tmp_path, second)
    for name in sealing.TABLES:
        assert_frame_equal(sealing.read(tmp_path)[name], pl.concat([first[name], second[name]]))


@pytest.mark.parametrize("written", range(len(sealing.TABLES)))
def test_a_first_cell_cut_off_before_its_last_table_leaves_no_finished_cell(tmp_path, written):
    sealing.append(tmp_path, cell("ddpg", 0))
    for name in sealing.TABLES[written:]:
        (tmp_path / f"{name}.parquet").unlink()
    assert sealing.finished(tmp_path) == set()
    assert sealing.read(tmp_path) == {}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two finished cells in a folder whose name polars would take for a pattern."""
    folder = tmp_path_factory.mktemp("runs") / "run[1]*?"
    folder.mkdir()
    sealing.append(folder, cell("ddpg", 0))
    sealing.append(folder, cell("me-ddpg", 10))
    return folder


def test_a_folder_is_read_by_its_name_and_not_as_a_pattern(folder):
    other = folder.with_name("run1")
    other.mkdir()
    sealing.append(other, cell("hs-ddpg", 7))
    assert sealing.finished(folder) == {("ddpg", 0), ("me-ddpg", 10)}


def other_rows(content):
    table = pl.read_parquet(io.BytesIO(content))
    return written(table.head(1))


def other_types(content):
    return written(pl.read_parquet(io.BytesIO(content)).cast({"seed": pl.Int16}))


def written(table):
    buffer = io.BytesIO()
    table.write_parquet(buffer)
    return buffer.getvalue()


def one_cell(content):
    return written(pl.read_parquet(io.BytesIO(content)).filter(pl.col("n_demos") == 0))


@pytest.mark.parametrize("table", sealing.TABLES)
@pytest.mark.parametrize("change", [other_rows, other_types, lambda content: b""])
def test_a_table_that_can_be_read_but_is_not_as_it_was_written_is_refused(folder, table, change):
    with damages.done_to(folder / f"{table}.parquet", change):
        _, refusal = damages.attempt(UserError, sealing.finished, folder)
    assert refusal == (
        f"--out: {folder} holds a damaged table ({table}.parquet is not as it was written)"
    )


@pytest.mark.parametrize("table", ["seeds", "episodes"])
def test_a_table_from_before_the_last_cell_is_refused_beside_a_later_one(folder, table):
    with damages.done_to(folder / f"{table}.parquet", one_cell):
        _, refusal = damages.attempt(UserError, sealing.finished, folder)
    assert f"({table}.parquet is not as it was written)" in refusal


def test_the_last_table_from_before_the_last_cell_is_that_of_a_cell_cut_off(folder):
    with damages.done_to(folder / "evaluations.parquet", one_cell):
        assert sealing.finished(folder) == {("ddpg", 0)}


@pytest.mark.parametrize("missing", ["tables.json", "seeds.parquet", "evaluations.parquet"])
def test_a_missing_file_is_refused(folder, missing):
    content = (folder / missing).read_bytes()
    (folder / missing).unlink()
    try:
        with pytest.raises(UserError, match="damaged table"):
            sealing.finished(folder)
    finally:
        (folder / missing).write_bytes(content)


def test_tables_of_a_later_version_are_refused(folder):
    with (
        damages.done_to(folder / "tables.json", lambda text: text.replace(b": 1", b": 2")),
        pytest.raises(UserError, match=r"has schema 2, this version reads 1"),
    ):
        sealing.finished(folder)


@pytest.mark.parametrize(
    "meanwhile", ["tables.json", *(f"{name}.parquet" for name in sealing.TABLES)]
)
def test_what_is_read_while_a_cell_is_added_is_whole(tmp_path, monkeypatch, meanwhile):
    first, second = cell("ddpg", 0), cell("me-ddpg", 10)
    sealing.append(tmp_path, first)
    read_bytes, added = Path.read_bytes, []

    def slow(path):
        content = read_bytes(path)
        if path.name == meanwhile and not added:
            added.append(True)
            sealing.append(tmp_path, second)
        return content

    monkeypatch.setattr(Path, "read_bytes", slow)
    tables = sealing.read(tmp_path)
    count = len(tables["evaluations"]) // len(first["evaluations"])
    for name in sealing.TABLES:
        assert_frame_equal(tables[name], pl.concat([first[name], second[name]][:count]))


@pytest.mark.parametrize("file", sealing.FILES)
@settings(max_examples=60)
@given(damage=damages.damages())
def test_a_file_damaged_anywhere_is_a_users_error_or_as_it_was(folder, file, damage):
    whole = sealing.read(folder)
    with damages.done_to(folder / file, damage):
        tables, refusal = damages.attempt(UserError, sealing.read, folder)
    if refusal is None:
        for name in sealing.TABLES:
            assert_frame_equal(tables[name], whole[name])
    else:
        assert str(folder) in refusal
        assert "\n" not in refusal
