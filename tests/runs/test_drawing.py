import subprocess
import sys

import matplotlib
import pytest

from cmedirl_jax.runs import drawing
from tests.support import ROOT


def figure():
    drawn = drawing.Figure()
    drawn.subplots().plot([0, 1], label="one")
    return drawn


def refuse(line):
    pytest.fail(line)


def test_the_users_settings_do_not_reach_a_figure_and_stay(tmp_path):
    files = [[tmp_path / name / f"one.{kind}" for kind in ("png", "svg")] for name in ("a", "b")]
    assert drawing.save(figure, files[0], refuse)
    # There is no LaTeX here, and no such font.
    with matplotlib.rc_context({"text.usetex": True, "font.family": "None", "lines.linewidth": 9}):
        assert drawing.save(figure, files[1], refuse)
        assert matplotlib.rcParams["lines.linewidth"] == 9
    for one, other in zip(*files, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert files[0][0].read_bytes().startswith(b"\x89PNG")
    assert files[0][1].read_bytes().startswith(b"<?xml")


def test_what_cannot_be_drawn_or_written_is_a_line(tmp_path):
    def broken():
        raise KeyError("two\nlines")

    lines = []
    # What was drawn before, of other numbers, does not stay.
    (tmp_path / "one.png").touch()
    assert not drawing.save(broken, [tmp_path / "one.png"], lines.append)
    (tmp_path / "file").touch()
    assert not drawing.save(figure, [tmp_path / "file" / "two.png"], lines.append)
    first, second = lines
    assert first == "one.png is not drawn (KeyError: 'two\\nlines')"
    assert second.startswith("two.png is not drawn (FileExistsError: ")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_neither_a_notebooks_backend_nor_a_broken_matplotlibrc_matters(tmp_path):
    (tmp_path / "matplotlibrc").write_bytes(b"font.size: many\n\xff")
    script = (
        "from cmedirl_jax.runs import drawing; from pathlib import Path\n"
        f"assert drawing.save(drawing.Figure, [Path({str(tmp_path / 'one.png')!r})], print)"
    )
    environment = {
        "MPLBACKEND": "module://not_installed_here.backend_inline",
        "MPLCONFIGDIR": str(tmp_path),
    }
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / "one.png").stat().st_size
