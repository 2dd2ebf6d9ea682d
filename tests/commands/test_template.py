"""A table to fill in."""

import polars as pl

from cmedirl_jax.commands.cmedirl import main


def test_a_template_is_read_and_never_written_over(tmp_path, capsys):
    out = tmp_path / "template.csv"
    assert main(["demos", "template", str(out), "--env", "PointMass-v0"]) == 0
    assert pl.read_csv(out).width == 1 + 4 + 2 + 3 + 4
    assert main(["demos", "template", str(out), "--env", "PointMass-v0"]) == 2
    assert "is there already" in capsys.readouterr().err
