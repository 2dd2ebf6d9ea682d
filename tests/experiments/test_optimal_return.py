import polars as pl
import pytest

from experiments import optimal_return


@pytest.mark.optimised
def test_values_and_what_is_attained_by_them(tmp_path, capsys):
    path = tmp_path / "new" / "optimal.csv"
    assert optimal_return.main(["--states", "51", "--starts", "4", "--out", str(path)]) == 0
    table = pl.read_csv(path)
    assert table["discount"].to_list() == [1.0] * 4 + [0.99] * 4
    assert table["start"].to_list()[:4] == pytest.approx([-0.575, -0.525, -0.475, -0.425])
    undiscounted, discounted = table.partition_by("discount", maintain_order=True)
    # The best of the scripted controllers, 0.2 in the direction of motion, returns 98.59.
    assert undiscounted["attained_return"].min() > 98.6
    assert undiscounted["attained"].to_list() == undiscounted["attained_return"].to_list()
    assert ((discounted["attained_return"] > 93) & (discounted["attained_return"] < 96)).all()
    for rows in (undiscounted, discounted):
        assert ((rows["value"] / rows["attained"] - 1).abs() < 0.03).all()
    assert f"Table: {path}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("--states 101 1", "--states: must be at least 2, got 1"),
        ("--actions 0", "--actions: must be at least 2, got 0"),
        ("--discount 1", "--discount: must be at least 0 and below 1, got 1.0"),
        ("--out .", "--out: cannot write to . (Is a directory)"),
        (
            "--states 11 2001",
            "the dynamics [S, A, successors] would be 3.36e+8 numbers (1.25 GiB in float32), "
            "more than 2^28: take fewer states, actions or subsamples",
        ),
        ("--starts 0", "--starts: must be at least 1, got 0"),
        ("--env Walker2d-v5", "unknown environment 'Walker2d-v5'; there are: "),
    ],
)
def test_mistakes_are_refused_in_a_line(arguments, line, capsys):
    assert optimal_return.main(arguments.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"optimal_return: {line}")
    assert error.count("\n") == 1
