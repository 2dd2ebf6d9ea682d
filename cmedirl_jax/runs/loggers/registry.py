"""The loggers by name."""

import importlib.util
from collections.abc import Iterable

from cmedirl_jax.registries import Registry
from cmedirl_jax.runs.loggers import csv, tensorboard, wandb
from cmedirl_jax.runs.loggers.base import Logger

LOGGERS: Registry[Logger] = Registry(
    "logger", {"csv": csv.CSV, "tensorboard": tensorboard.TENSORBOARD, "wandb": wandb.WANDB}
)
"""Maps each name to its logger."""


def check(names: Iterable[str]) -> None:
    """Check that loggers are known and what they need is installed; imports nothing.

    Raises:
        ValueError: naming the first that is not.
    """
    for name in names:
        if name not in LOGGERS:
            raise ValueError(f"unknown logger {name!r}; there are {', '.join(LOGGERS)}")
        package = LOGGERS[name].package
        if package is not None and importlib.util.find_spec(package) is None:
            raise ValueError(
                f"{package} is not installed: python -m pip install 'cmedirl-jax[log]'"
            )
