import numpy as np
import polars as pl
import pytest

from cmedirl_jax.data import demonstrations
from experiments import datasets
from experiments.datasets import Task
from tests.support import pools


@pytest.fixture
def commands(monkeypatch, tmp_path):
    """What `cmedirl` was given; in its place three scripted episodes are written."""
    given = []

    def recorded(arguments):
        given.append(arguments)
        if arguments[0] == "train":
            return 0
        name, quality = arguments[2], arguments[arguments.index("--quality") + 1]
        pool = pools.scripted(3, push=0.8 if quality == "expert" else 0.3)
        facts = {"ref_min_score": -33.0, "ref_max_score": 95.0, "algorithm_name": "ddpg"}
        facts |= {"author": "a", "author_email": "b", "code_permalink": "c", "description": "d"}
        demonstrations.to_minari(pool, name, spec=pools.ENV.spec, **facts)
        return 0

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setattr(datasets.cmedirl, "main", recorded)
    monkeypatch.setattr(datasets, "TASKS", (Task("MountainCarContinuous-v0", "test/car", 12, 5),))
    return given


def option(arguments, name):
    return arguments[arguments.index(name) + 1]


def test_one_command_makes_every_dataset_and_a_table_of_them(commands, tmp_path, capsys):
    minari = pytest.importorskip("minari")
    command = ["--seeds", "2", "--episodes", "3", "--out", str(tmp_path / "runs")]
    assert datasets.main(command) == 0
    names = [f"test/car/{quality}-v0" for quality in ("expert", "medium", "mixed")]
    assert sorted(minari.list_local_datasets()) == names
    table = pl.read_csv(tmp_path / "runs" / "datasets.csv")
    assert table["dataset"].to_list() == names
    assert table["episodes"].to_list() == [3, 3, 3]
    returns = [demonstrations.returns(pools.scripted(3, push)).mean() for push in (0.8, 0.3)]
    np.testing.assert_allclose(table["return_mean"][:2], returns, atol=0.01)
    np.testing.assert_allclose(table["score"][0], (returns[0] + 33) / (95 + 33), atol=0.01)

    # The expert is another run's, and all three are measured by it.
    trained, records = commands[::2], commands[1::2]
    assert [option(each, "--max-steps") for each in trained] == ["12", "5", "5"]
    assert [option(each, "--seed") for each in trained] == ["0", "1", "1"]
    assert [option(each, "--run") for each in records] == [option(x, "--out") for x in trained]
    assert ["--ref-max-score" in each for each in records] == [False, True, True]
    assert option(records[1], "--ref-max-score") == "95.0"

    # What is there stays, unless it is another dataset.
    commands.clear()
    assert datasets.main(command) == 0
    assert commands == []
    capsys.readouterr()
    assert datasets.main([*command, "--episodes", "5"]) == 2
    assert "--episodes: test/car/expert-v0 is there and has 3" in capsys.readouterr().err


def test_a_table_elsewhere_is_refused_before_the_work(tmp_path, capsys):
    (tmp_path / "datasets.csv").mkdir()
    assert datasets.main(["--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("datasets: --out: cannot write to")
