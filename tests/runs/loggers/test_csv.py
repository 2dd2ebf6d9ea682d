from cmedirl_jax.runs.loggers.base import Point
from cmedirl_jax.runs.loggers.csv import CSV
from tests.support import logs


def test_each_point_is_a_row_and_each_scalar_a_column(tmp_path):
    writer = CSV.open(tmp_path, "mean", {})
    writer.write([Point(0, {"return_mean": 0.5}), Point(50, {"return_mean": -1e-9, "q_mean": 2.0})])
    writer.close()
    assert (tmp_path / "csv" / "mean.csv").read_bytes() == (
        b"step,return_mean,q_mean\n0,0.5,\n50,-1e-09,2.0\n"
    )


def test_what_is_on_the_disk_does_not_depend_on_how_the_points_came(tmp_path):
    points = [Point(step, {f"scalar {step}": step / 3, "q_mean": 1.0}) for step in range(4)]
    for series, pieces in {"one": [points], "many": [[point] for point in points]}.items():
        writer = CSV.open(tmp_path, series, {})
        for piece in pieces:
            writer.write(piece)
            assert len(logs.table(tmp_path / "csv" / f"{series}.csv")) == piece[-1].step + 1
    one, many = ((tmp_path / "csv" / f"{series}.csv").read_bytes() for series in ("one", "many"))
    assert one == many
