"""Weights & Biases, offline: a run of theirs for each series, `wandb/offline-run-*`.

Nothing is sent anywhere: `wandb sync` does that later.
"""

import importlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cmedirl_jax.runs.loggers.base import Logger, Point


class _Writer:
    def __init__(self, run: Any):
        self._run = run

    def write(self, points: Sequence[Point]) -> None:
        for step, scalars in points:
            self._run.log(dict(scalars), step=step)

    def close(self) -> None:
        self._run.finish()


def _open(folder: Path, series: str, config: Mapping[str, Any]) -> _Writer:
    # By its name: beside this file, which is called alike, a checker of types would take this one.
    wandb: Any = importlib.import_module("wandb")
    folder.mkdir(parents=True, exist_ok=True)
    run = wandb.init(
        mode="offline",
        # wandb makes a folder `wandb` in it.
        dir=folder,
        project=os.environ.get("WANDB_PROJECT", "cmedirl_jax"),
        group=folder.name,
        name=series,
        config=dict(config),
        # Beside the runs of the other series, and those of a program that calls this one.
        reinit="create_new",
        settings=wandb.Settings(
            silent=True,
            console="off",
            # For each seed again they would be 70 ms and a thread that measures the machine.
            x_save_requirements=False,
            x_disable_stats=True,
            disable_git=True,
            save_code=False,
        ),
    )
    return _Writer(run)


WANDB = Logger(_open, package="wandb")
