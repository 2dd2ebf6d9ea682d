"""Show an episode of a policy that a run has learned, as a GIF or in a window.

Example: cmedirl watch results/tuned --method hs-me-ddpg --seed 3 --out car.gif
"""

import dataclasses
import io
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
from PIL import Image

from cmedirl_jax.commands import sources
from cmedirl_jax.ranges import Count, Size
from cmedirl_jax.runs.console import screen
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs

MILLISECONDS = 40
"""How long each frame is shown."""


@dataclasses.dataclass(frozen=True)
class Options(sources.PolicyOptions):
    """Which policy, and where to show it.

    Attributes:
        reset_seed: Gymnasium's, for the start of the episode.
        every: Steps from one frame to the next.
        width: Of the picture, in pixels.
        window: Show it in a window, and write no file.
        out: A GIF file.
    """

    reset_seed: Count = 0
    every: Size = 2
    width: Size = 300
    window: bool = False
    out: Path = Path("episode.gif")


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    if not options.window:
        outputs.check("out", options.out)
        if options.out.suffix != ".gif":
            raise UserError(f"--out: {options.out} does not end in .gif")
    policy = sources.policy(options.folder, options.method, options.seed, options.n_demos)
    mode = "human" if options.window else "rgb_array"
    if not options.window:
        # Frames are drawn in memory: no screen is looked for.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        if sys.platform == "linux" and "DISPLAY" not in os.environ:
            os.environ.setdefault("MUJOCO_GL", "egl")
    frames = of_episode(jax.jit(policy.act), policy.task, options.reset_seed, options.every, mode)
    if not options.window:
        outputs.write(options.out, gif(frames, options.width))
        screen.say(screen.console(), f"{options.out}: {len(frames)} frames")
    return 0


def of_episode(
    policy: Callable[[Any], jax.Array],
    task: str,
    reset_seed: int,
    every: int,
    render_mode: str = "rgb_array",
) -> list[np.ndarray]:
    """Every so many frames `[height, width, 3]` uint8 of an episode, and its last one.

    With `render_mode` "human" they go to a window, and None stands for each.

    Raises:
        UserError: if Gymnasium cannot draw the task.
    """
    try:
        env = gymnasium.make(task, render_mode=render_mode)
        observation, _ = env.reset(seed=reset_seed)
        frames: list[Any] = [env.render()]
        ended, steps = False, 0
        while not ended:
            action = np.asarray(policy(np.asarray(observation, np.float32)), np.float32)
            observation, _, terminated, truncated, _ = env.step(action)
            ended, steps = terminated or truncated, steps + 1
            if ended or steps % every == 0:
                frames.append(env.render())
        env.close()
    # Simulators and the libraries that they draw with raise what they like.
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"{task}: Gymnasium cannot draw it ({reason})") from error
    return frames


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
