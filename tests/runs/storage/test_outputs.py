import pytest

from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs


def test_a_file_that_could_not_be_written_is_refused_and_nothing_is_left(tmp_path):
    (tmp_path / "file").touch()
    for path, reason in (
        (tmp_path, "Is a directory"),
        (tmp_path / "file" / "new" / "table.csv", "Not a directory"),
        (tmp_path / ("x" * 300) / "table.csv", "File name too long"),
        (tmp_path / ("x" * 300), "File name too long"),
    ):
        with pytest.raises(UserError) as refusal:
            outputs.check("out", path)
        assert str(refusal.value) == f"--out: cannot write to {path} ({reason})"
    outputs.check("out", tmp_path / "new" / "table.csv")
    outputs.check("out", tmp_path / "file")
    outputs.check("out", None)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_file_is_written_with_its_folder_and_an_equal_one_stays(tmp_path):
    path = tmp_path / "new" / "table.csv"
    outputs.write(path, b"1")
    first = path.stat()
    outputs.write(path, b"1")
    assert path.stat() == first
    outputs.write(path, b"2")
    assert path.read_bytes() == b"2"
    assert [file.name for file in path.parent.iterdir()] == ["table.csv"]
