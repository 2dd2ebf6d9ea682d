import subprocess
import sys

import pytest

from cmedirl_jax.runs.loggers.base import Point
from cmedirl_jax.runs.loggers.tensorboard import TENSORBOARD
from tests.support import ROOT, logs


def test_tensorboard_reads_every_point_as_soon_as_it_is_written(tmp_path):
    mean, seed = (TENSORBOARD.open(tmp_path, series, {}) for series in ("mean", "seed-3"))
    mean.write([Point(0, {"return_mean": 0.5}), Point(250, {"return_mean": 1.5, "q_mean": -2.0})])
    seed.write([Point(0, {"return_mean": 7.0})])
    expected = {"return_mean": [(0, 0.5), (250, 1.5)], "q_mean": [(250, -2.0)]}
    assert logs.scalars(tmp_path / "tensorboard" / "mean") == expected
    mean.write([Point(500, {"q_mean": 4.0})])
    mean.close()
    expected["q_mean"].append((500, 4.0))
    assert logs.scalars(tmp_path / "tensorboard" / "mean") == expected
    assert logs.scalars(tmp_path / "tensorboard" / "seed-3") == {"return_mean": [(0, 7.0)]}


def test_an_event_that_a_kill_cut_short_is_skipped(tmp_path):
    TENSORBOARD.open(tmp_path, "mean", {}).write([Point(step, {"q_mean": 1.0}) for step in (0, 9)])
    (file,) = (tmp_path / "tensorboard" / "mean").iterdir()
    file.write_bytes(file.read_bytes()[:-3])
    assert logs.scalars(file.parent) == {"q_mean": [(0, 1.0)]}


def test_a_file_that_cannot_be_written_is_an_error_of_the_call(tmp_path):
    writer = TENSORBOARD.open(tmp_path, "mean", {})
    (file,) = (tmp_path / "tensorboard" / "mean").iterdir()
    file.unlink()
    file.mkdir()
    with pytest.raises(OSError, match="directory"):
        writer.write([Point(0, {"q_mean": 1.0})])


def test_neither_tensorflow_nor_torch_is_looked_for(tmp_path):
    script = (
        "import pathlib, sys\n"
        "sys.modules |= dict.fromkeys(('tensorflow', 'tensorboardX', 'torch'))\n"
        "from cmedirl_jax.runs.loggers.base import Point\n"
        "from cmedirl_jax.runs.loggers.tensorboard import TENSORBOARD\n"
        "assert 'tensorboard' not in sys.modules\n"
        f"writer = TENSORBOARD.open(pathlib.Path({str(tmp_path)!r}), 'mean', {{}})\n"
        "writer.write([Point(0, {'q_mean': 1.0})])\n"
        "assert 'tensorboard.compat.notf' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=True)
    assert logs.scalars(tmp_path / "tensorboard" / "mean") == {"q_mean": [(0, 1.0)]}
