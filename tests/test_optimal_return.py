import polars as pl
import pytest

from experiments import optimal_return


@pytest.mark.optimised
def test_values_and_what_is_attained_by_them(tmp_path, capsys):
    path = tmp_path / "new" / "optimal.csv"
    assert optimal_return.main(["--states", "51", "--starts", "4", "--out", str(path)]) == 0
    table = pl.read_csv(path)
    assert table["discount"].to_list() == [1.0] * 4 + [0.99] * 4
    assert table["start"].to_list()[:4] == pytest.approx([-0.6, -0.5333333, -0.4666667, -0.4])
    undiscounted, discounted = table.partition_by("discount", maintain_order=True)
    # The best of the scripted controllers, 0.2 in the direction of motion, returns 98.59.
    assert undiscounted["attained_return"].min() > 98.6
    assert undiscounted["attained"].to_list() == undiscounted["attained_return"].to_list()
    assert ((discounted["attained_return"] > 93) & (discounted["attained_return"] < 96)).all()
    for rows in (undiscounted, discounted):
        assert ((rows["value"] / rows["attained"] - 1).abs() < 0.03).all()
    assert f"Table: {path}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--states", "1"], "a grid needs two points along each dimension"),
        (["--starts", "0"], "starts must be at least 1, got 0"),
        (["--env", "Pendulum-v1"], "unknown environment"),
    ],
)
def test_mistakes_end_in_one_line(arguments, message, capsys):
    assert optimal_return.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("optimal_return: ")
    assert message in error
    assert error.count("\n") == 1
