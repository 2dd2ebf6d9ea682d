import polars as pl
import pytest

from experiments import datasets
from experiments.datasets import Task

OPTIONS = ["--seeds", "2", "--episodes", "2"]


def test_one_command_makes_every_dataset_and_a_table_of_them(tmp_path, monkeypatch, capsys):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setattr(datasets, "TASKS", (Task("MountainCarContinuous-v0", "test/car", 10, 10),))
    monkeypatch.setattr("cmedirl_jax.runs.train.FRESH_STARTS", 2)
    command = [*OPTIONS, "--out", str(tmp_path / "runs")]
    assert datasets.main(command) == 0
    table = pl.read_csv(tmp_path / "runs" / "datasets.csv")
    names = [f"test/car/{quality}-v0" for quality in ("expert", "medium", "mixed")]
    assert table["dataset"].to_list() == names
    assert table["episodes"].to_list() == [2, 2, 2]
    assert sorted(minari.list_local_datasets()) == names
    # What is there stays.
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "minari").rglob("*.hdf5")}
    assert datasets.main(command) == 0
    assert {path: path.stat().st_mtime_ns for path in files} == files
    assert len(files) == 3
    capsys.readouterr()
    assert datasets.main([*command, "--episodes", "5"]) == 2
    assert "--episodes: test/car/expert-v0 is there and has 2" in capsys.readouterr().err


def test_a_table_elsewhere_is_refused_before_the_work(tmp_path, capsys):
    (tmp_path / "datasets.csv").mkdir()
    assert datasets.main(["--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("datasets: --out: cannot write to")
