"""Tables: their template, and layouts that are not theirs."""

import polars as pl
import pytest

from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.formats import tables
from tests.support.formats import SPEC, as_csv, episodes


def test_a_template_has_every_column_and_is_read(tmp_path):
    for ending in (".csv", ".parquet"):
        path = tmp_path / f"template{ending}"
        tables.write_template(path, SPEC)
        pool = demonstrations.read(path, env=SPEC)
        assert pool.transition.terminated.tolist() == [False, True]
        tables.write_table(path, pool)
        assert demonstrations.read(path, env=SPEC).metadata == pool.metadata
    with pytest.raises(ValueError, match=r"ends in .csv or .parquet"):
        tables.write_template(tmp_path / "template.xlsx", SPEC)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.drop("episode"), "it has no column 'episode'"),
        (lambda table: table.drop("observation_0"), "columns observation_ are not numbered from 0"),
        (lambda table: table.rename({"reward": "pay"}), "unknown column 'pay'"),
        (lambda table: table.drop("next_observation_1"), "not as many columns next_observation_"),
        (lambda table: table.with_columns(episode=pl.col("episode") + 0.5), "not whole numbers"),
        (lambda table: table.with_columns(action_0=pl.lit("left")), "actions are .*not numbers"),
    ],
)
def test_tables_of_another_layout_are_refused_by_their_column(change, message, tmp_path):
    path = as_csv(episodes(), tmp_path / "pool")
    change(pl.read_csv(path)).write_csv(path)
    with pytest.raises(ValueError, match=message):
        demonstrations.read(path, env=SPEC)
