"""The loggers by name."""

import importlib.metadata
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
        package = LOGGERS[name].package
        try:
            # A folder of that name would pass for a module.
            version = package and importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            version = None
        if package is not None and version is None:
            raise ValueError(f"{package} is not installed: python -m pip install {package}")
