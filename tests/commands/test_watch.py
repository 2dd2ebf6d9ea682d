import io

import numpy as np
import pytest
from PIL import Image

from cmedirl_jax.commands import watch
from cmedirl_jax.commands.cmedirl import main


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    """What the command sets for the libraries that draw is unset again: MuJoCo reads it too."""
    for name in ("SDL_VIDEODRIVER", "MUJOCO_GL"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


def test_the_command_films_an_episode(untrained_run, tmp_path, capsys):
    out = tmp_path / "film.gif"
    options = ["--method", "hs-ddpg", "--n-demos", "7", "--every", "400", "--width", "60"]
    assert main(["watch", str(untrained_run), *options, "--out", str(out)]) == 0
    # An untrained policy: the start, steps 400 and 800, and the end at 999.
    assert capsys.readouterr().out == f"{out}: 4 frames\n"
    with Image.open(out) as picture:
        assert (picture.format, picture.size) == ("GIF", (60, 40))


def test_frames_follow_the_policy():
    frames = watch.of_episode(
        lambda observation: np.sign(observation[1:] + 1e-9), "MountainCarContinuous-v0", 0, 10
    )
    assert 8 < len(frames) < 20
    assert all(frame.shape == (400, 600, 3) for frame in frames)
    assert len({frame.tobytes() for frame in frames}) == len(frames)


def test_a_gif_holds_every_frame():
    shades = [np.full((20, 30, 3), shade, np.uint8) for shade in (0, 128, 255)]
    with Image.open(io.BytesIO(watch.gif(shades, 15))) as picture:
        assert (picture.n_frames, picture.size) == (3, (15, 10))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["nowhere"], "nowhere: holds no run"),
        (["{run}", "--method", "gail"], "holds no method gail"),
        (["{run}", "--method", "hs-ddpg"], "holds several of hs-ddpg, seed 0; give one of"),
        (["{run}", "--out", "car.mp4"], "--out: car.mp4 does not end in .gif"),
        (["{run}", "--every", "0"], "--every: must be at least 1, got 0"),
    ],
)
def test_mistakes_are_refused_in_a_line(untrained_run, arguments, named, capsys):
    command = ["watch", *(argument.format(run=untrained_run) for argument in arguments)]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1


def test_a_task_that_gymnasium_cannot_draw_is_refused():
    with pytest.raises(watch.UserError, match="Gymnasium cannot draw it"):
        watch.of_episode(lambda observation: observation, "NoSuchTask-v0", 0, 1)


def test_a_window_shows_it_and_nothing_is_written(untrained_run, tmp_path, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(watch, "of_episode", lambda *arguments: [arguments[-1]])
    options = ["--method", "hs-ddpg", "--n-demos", "7", "--window"]
    assert main(["watch", str(untrained_run), *options]) == 0
    assert list(tmp_path.iterdir()) == []
