"""Demonstrations of one format in another, on the command line."""

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
