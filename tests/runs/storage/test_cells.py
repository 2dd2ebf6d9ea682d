import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from cmedirl_jax.io import checkpoint
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import cells, sealing, tables
from cmedirl_jax.runs.storage.cells import CellKey
from tests.support import cells as cells_of


def save(folder, method="ddpg", n_demos=0, first_seed=0, seeds=2):
    return cells_of.save(folder, CellKey(0, "none", method, n_demos, first_seed, seeds))


def keys(folder):
    return [cell.key for cell in cells.finished(folder)]


def test_a_cell_comes_back_with_all_that_it_is(tmp_path):
    trees = {"policies": {"kernel": np.ones((2, 3))}, "rewards": None}
    key = CellKey(4, "best", "me-ddpg", 5, 10, 2)
    rows = cells_of.rows(key)
    cells.save(tmp_path, key, {"task": {"id": "Car"}}, rows, trees)
    (cell,) = cells.finished(tmp_path)
    assert cell.key == key
    assert cell.path == tmp_path / "cells" / "me-ddpg-n5-seeds-10-11"
    assert cell.seal["task"] == {"id": "Car"}
    assert str(key) == "me-ddpg, n_demos 5, seeds 10 to 11"
    for name, table in rows.items():
        assert_frame_equal(cell.table(name), table)
    np.testing.assert_array_equal(
        checkpoint.load(cell.path / "policies")["kernel"], trees["policies"]["kernel"]
    )
    assert not (cell.path / "rewards").exists()


def test_a_folder_without_cells_has_none(tmp_path):
    assert cells.finished(tmp_path) == []
    assert not cells.any_begun(tmp_path)
    (tmp_path / "cells" / ".ddpg-seeds-0-1.partial").mkdir(parents=True)
    (tmp_path / "cells" / "notes.txt").touch()
    assert cells.finished(tmp_path) == []
    assert not cells.any_begun(tmp_path)


def test_a_folder_is_read_by_its_name_and_not_as_a_pattern(tmp_path):
    folder = tmp_path / "run[1]*?"
    save(folder)
    save(tmp_path / "run1", "hs-ddpg", 7)
    (cell,) = cells.finished(folder)
    assert cell.key.method == "ddpg"
    assert cell.table("seeds").height == 2


@pytest.mark.parametrize("name", [*(f"{name}.parquet" for name in cells.TABLES), sealing.SEAL])
def test_a_damaged_cell_is_refused_in_a_line(tmp_path, name):
    path = save(tmp_path)
    (path / name).write_bytes(b"PAR1")
    with pytest.raises(UserError) as refused:
        cells.finished(tmp_path)
    assert str(refused.value) == (
        f"{path} is damaged ({name}); bring it back, or remove it to train the cell again"
    )


def test_another_valid_table_in_its_place_is_refused(tmp_path):
    path = save(tmp_path)
    table = pl.read_parquet(path / "seeds.parquet")
    table.head(1).write_parquet(path / "seeds.parquet")
    with pytest.raises(UserError, match=r"is damaged \(seeds\.parquet\)"):
        cells.finished(tmp_path)


def test_a_sealed_folder_that_is_no_cell_is_refused(tmp_path):
    with sealing.sealed(tmp_path / "cells" / "mine", {"step": 1}):
        pass
    with pytest.raises(UserError, match="mine is no cell of a run"):
        cells.finished(tmp_path)


def test_a_cell_of_a_later_version_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(sealing, "SCHEMA", 4)
    save(tmp_path)
    monkeypatch.undo()
    with pytest.raises(UserError, match="has schema 4, this version reads 3"):
        cells.finished(tmp_path)


def test_a_method_without_demonstrations_has_one_cell():
    asked = cells.asked(["ddpg", "me-ddpg"], [1, 10])
    assert asked == [("ddpg", 0), ("me-ddpg", 1), ("me-ddpg", 10)]
    names = [cells.name(method, n_demos, 0, 100) for method, n_demos in asked]
    assert names == ["ddpg-seeds-0-99", "me-ddpg-n1-seeds-0-99", "me-ddpg-n10-seeds-0-99"]


def missing(folder, seeds, method="me-ddpg", n_demos=5, at_once=None):
    return cells.missing_blocks(folder, keys(folder), method, n_demos, seeds, at_once)


def test_seeds_are_trained_in_blocks_and_never_twice(tmp_path):
    assert missing(tmp_path, 4) == [range(4)]
    save(tmp_path, "me-ddpg", 5, 0, 4)
    assert missing(tmp_path, 4) == []
    assert missing(tmp_path, 3) == []
    assert missing(tmp_path, 9) == [range(4, 9)]
    save(tmp_path, "me-ddpg", 5, 4, 5)
    assert missing(tmp_path, 9) == []
    assert missing(tmp_path, 10) == [range(9, 10)]
    assert missing(tmp_path, 4, n_demos=6) == [range(4)]
    assert missing(tmp_path, 4, method="hs-ddpg") == [range(4)]


def test_a_block_that_has_a_checkpoint_stays_as_it_was_begun(tmp_path):
    (tmp_path / "checkpoints" / "me-ddpg-n5-seeds-0-3").mkdir(parents=True)
    assert missing(tmp_path, 10) == [range(4), range(4, 10)]
    assert missing(tmp_path, 4) == [range(4)]
    # Fewer seeds than it has are another block.
    assert missing(tmp_path, 3) == [range(3)]
    assert missing(tmp_path, 10, n_demos=50) == [range(10)]


def test_a_new_block_has_no_more_seeds_than_train_at_once(tmp_path):
    save(tmp_path, "me-ddpg", 5, 0, 4)
    (tmp_path / "checkpoints" / "me-ddpg-n5-seeds-4-8").mkdir(parents=True)
    assert missing(tmp_path, 14, at_once=3) == [range(4, 9), range(9, 12), range(12, 14)]
    assert missing(tmp_path, 3, method="hs-ddpg", at_once=3) == [range(3)]


@pytest.fixture
def folder(tmp_path):
    for method, n_demos, first, seeds in (
        *(("me-ddpg", 5, 2, 3), ("me-ddpg", 5, 0, 2)),
        *(("me-ddpg", 7, 0, 2), ("ddpg", 0, 0, 2)),
    ):
        save(tmp_path, method, n_demos, first, seeds)
    return tmp_path


def asked(folder, methods, n_demos, seeds):
    config = {"methods": methods, "n_demos": n_demos, "seeds": seeds}
    table = tables.read(folder, config)["seeds"]
    return table.select("method", "n_demos", "seed").rows()


def test_the_tables_hold_the_cells_asked_for_in_their_order(folder):
    assert asked(folder, ["ddpg", "me-ddpg"], [5], 5) == [
        *(("ddpg", 0, seed) for seed in range(2)),
        *(("me-ddpg", 5, seed) for seed in range(5)),
    ]
    assert asked(folder, ["me-ddpg"], [7, 5], 3) == [
        *(("me-ddpg", 7, seed) for seed in range(2)),
        *(("me-ddpg", 5, seed) for seed in range(3)),
    ]


def test_tables_of_an_older_version_are_refused(tmp_path):
    key = CellKey(0, "best", "me-ddpg", 5, 0, 2)
    rows = cells_of.rows(key)
    cells_of.save(tmp_path, key, rows | {"seeds": rows["seeds"].drop("expert_id")})
    with pytest.raises(UserError, match="older version wrote its cells, without expert_id; read"):
        asked(tmp_path, ["me-ddpg"], [5], 2)


def test_tables_of_no_finished_cell_are_refused(folder):
    with pytest.raises(UserError, match="holds no finished cell of a run"):
        asked(folder, ["hs-ddpg"], [5], 2)
    with pytest.raises(UserError, match="names no cells"):
        asked(folder, ["td3"], [5], 2)


def test_tables_that_are_there_already_stay_untouched(folder):
    config = {"methods": ["ddpg"], "n_demos": [5], "seeds": 2}
    tables.write(folder, tables.read(folder, config))
    paths = [folder / name for name in tables.FILES]
    before = [path.stat().st_mtime_ns for path in paths]
    (folder / "seeds.parquet").write_bytes(b"another")
    tables.write(folder, tables.read(folder, config))
    assert [path.stat().st_mtime_ns for path in paths][:2] == before[:2]
    assert pl.read_parquet(folder / "seeds.parquet").height == 2
