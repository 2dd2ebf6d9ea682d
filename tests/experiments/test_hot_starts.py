import numpy as np
import polars as pl
import pytest

from cmedirl_jax.agents import hot_start
from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs.cells import pools as pools_lib
from experiments import hot_starts
from experiments.hot_starts import CRITICS, Options
from tests.support import pools


@pytest.mark.slow
def test_a_row_for_each_loss_with_intervals_over_the_learners(tmp_path, monkeypatch, capsys):
    path, out = tmp_path / "pool.npz", tmp_path / "hot_starts.csv"
    demonstrations.save(path, pools.scripted(3))
    monkeypatch.setattr(hot_starts, "CRITICS", CRITICS[:1])
    options = ["--demos", str(path), "--seeds", "3", "--updates", "5", "--out", str(out)]
    assert hot_starts.main(options) == 0
    (row,) = pl.read_csv(out).to_dicts()
    assert row["critic"] == "softmax"
    for name in hot_starts.Found._fields:
        assert row[f"{name}_low"] <= row[name] <= row[f"{name}_high"]
    assert "softmax" in capsys.readouterr().out


def test_values_fitted_to_the_returns_follow_them_and_one_update_changes_little():
    shared = pools_lib.of_learners(pools.scripted(3), 2)
    found = hot_starts.of_critic(
        "monte-carlo", shared.data, pools.ENV, Options(None, seeds=2, updates=1)
    )
    assert (found.correlation > 0.5).all()
    # An initial critic, whose values are near zero, misses by the size of the returns.
    size = np.sqrt(np.mean(np.square(shared.data.discounted_return)))
    assert (found.error < 0.6 * size).all()
    assert (found.action_change < 0.01).all()
    np.testing.assert_allclose(found.return_before, found.return_after, atol=1.0)


def test_the_five_losses_are_those_of_the_hot_start():
    assert len(CRITICS) == 5
    for critic in CRITICS:
        assert hot_start.HotStartHParams(critic=critic).critic == critic


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--demos", "nowhere.npz"], "--demos: there is no file nowhere.npz"),
        (["--demos", "a.npz", "--env", "Nothing-v0"], "--env: unknown environment 'Nothing-v0'"),
        (["--demos", "a.npz", "--seeds", "0"], "--seeds: must be at least 1, got 0"),
    ],
)
def test_mistakes_are_refused_in_a_line(arguments, named, capsys):
    assert hot_starts.main(arguments) == 2
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1
