"""Demonstrations of one format in another, on the command line."""

import numpy as np
import polars as pl
import pytest

from cmedirl_jax.commands.cmedirl import main
from cmedirl_jax.data import demonstrations
from tests.support import pools

CAR = ["--env", pools.ENV.spec.id]


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
    assert main(["demos", "convert", str(table), "test/cars-v0", *CAR]) == 0
    # What Minari misses is a line each.
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    assert all(line.startswith("test/cars-v0: `") for line in lines)
    assert minari.load_dataset("test/cars-v0").total_episodes == 3
    assert main(["demos", "inspect", "test/cars-v0", *CAR]) == 0
    assert main(["demos", "convert", str(table), "test/cars-v0", *CAR]) == 2
    assert "already exist" in capsys.readouterr().err


def test_only_good_episodes_are_kept_if_asked(table, tmp_path, capsys):
    returns = demonstrations.returns(pools.scripted(3))
    least, out = np.median(returns), tmp_path / "good.npz"
    command = ["demos", "convert", str(table), str(out), *CAR, "--min-return"]
    assert main([*command, str(least - 1e-3)]) == 0
    pool = demonstrations.load(out, pools.ENV.spec)
    np.testing.assert_allclose(demonstrations.returns(pool), returns[returns >= least], rtol=1e-5)
    demonstrations.check(pool, pools.ENV)
    assert main([*command, "1000"]) == 2
    assert "--min-return: the best of 3 episodes returns" in capsys.readouterr().err
