"""`python -m experiments.film RUN`: an episode of a learned policy, drawn by Gymnasium, as a GIF.

It needs what Gymnasium draws the task with: `pip install -e '.[gymnasium]'`.
"""

import dataclasses
import io
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import jax
import numpy as np
import tyro
from PIL import Image

from cmedirl_jax.ranges import Count, Size
from cmedirl_jax.runs import start
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.load import load_policy
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import outputs

MILLISECONDS = 40
"""That a frame is shown."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Which policy, and where to write its film.

    Attributes:
        folder: A run's folder.
        method: Which method's policy.
        seed: Of which learner.
        n_demos: Demonstrations of the learner, where the run has several numbers of them.
        reset_seed: Gymnasium's, for the start of the episode.
        every: Steps from one frame to the next.
        width: Of the picture, in pixels.
        out: A GIF file.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    method: str = "hs-me-ddpg"
    seed: Count = 0
    n_demos: Size | None = None
    reset_seed: Count = 0
    every: Size = 2
    width: Size = 300
    out: Path = Path("film.gif")


@ending.in_a_line("film")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "experiments.film", __doc__, arguments)
    outputs.check("out", options.out)
    task = run_folder.read(options.folder)["config"]["env"]
    # Frames are drawn in memory: no screen is looked for.
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    start.devices()
    try:
        policy = load_policy(options.folder, options.method, options.seed, options.n_demos)
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from error
    frames = of_episode(jax.jit(policy), task, options.reset_seed, options.every)
    outputs.write(options.out, gif(frames, options.width))
    screen.say(screen.console(), f"Film: {options.out}, {len(frames)} frames")
    return 0


def of_episode(
    policy: Callable[[Any], jax.Array], task: str, reset_seed: int, every: int
) -> list[np.ndarray]:
    """Every so many frames `[height, width, 3]` uint8 of an episode, and its last one.

    Raises:
        UserError: if Gymnasium cannot draw the task.
    """
    try:
        env = gymnasium.make(task, render_mode="rgb_array")
        observation, _ = env.reset(seed=reset_seed)
        frames, ended, steps = [env.render()], False, 0
        while not ended:
            observation, _, terminated, truncated, _ = env.step(np.asarray(policy(observation)))
            ended, steps = terminated or truncated, steps + 1
            if ended or steps % every == 0:
                frames.append(env.render())
        env.close()
    except (gymnasium.error.Error, TypeError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{task}: Gymnasium cannot draw it ({reason})") from error
    return [np.asarray(frame) for frame in frames]


def gif(frames: Sequence[np.ndarray], width: int) -> bytes:
    """Frames as an endless GIF of this width."""
    first, *others = (
        Image.fromarray(frame)
        .resize((width, round(width * frame.shape[0] / frame.shape[1])))
        .quantize(32)
        for frame in frames
    )
    content = io.BytesIO()
    first.save(
        content,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=MILLISECONDS,
        loop=0,
        optimize=True,
    )
    return content.getvalue()


if __name__ == "__main__":
    sys.exit(main())
