"""What is in demonstrations, on the command line."""

import numpy as np
import polars as pl
import pytest

from cmedirl_jax.commands.cmedirl import main
from cmedirl_jax.data import demonstrations
from tests.support import pools

CAR = ["--env", pools.ENV.spec.id]


def test_inspect_counts_what_is_there_and_draws_it(table, tmp_path, capsys):
    picture = tmp_path / "pool.png"
    assert main(["demos", "inspect", str(table), *CAR, "--picture", str(picture)]) == 0
    output = capsys.readouterr().out
    pool = pools.scripted(3)
    assert f"3 episodes, {len(pool.episode)} steps; the task ended 3, a time limit" in output
    assert "Every step is one of MountainCarContinuous-v0" in output
    rows = {line.split()[0]: line.split()[1:] for line in output.splitlines() if line.split()}
    returns = demonstrations.returns(pool)
    assert float(rows["return"][2]) == pytest.approx(np.median(returns), rel=1e-3)
    assert rows["action[0]"][-3:] == ["-1", "to", "1"]
    assert picture.read_bytes()[1:4] == b"PNG"


def test_inspect_names_what_is_wrong_and_what_is_absent(table, tmp_path, capsys):
    wrong = pl.read_csv(table).with_columns(action_0=pl.lit(0.3))
    wrong.write_csv(table)
    assert main(["demos", "inspect", str(table), *CAR]) == 1
    assert "episode 0, step" in capsys.readouterr().out
    wrong.drop("reward").write_csv(table)
    assert main(["demos", "inspect", str(table), *CAR, "--picture", str(tmp_path / "x.gif")]) == 2
    assert main(["demos", "inspect", str(table), *CAR]) == 1
    output = capsys.readouterr().out
    assert "There are no rewards" in output
    assert "\nreturn" not in output
