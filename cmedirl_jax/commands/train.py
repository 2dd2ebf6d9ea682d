"""Learn a reward and a policy from demonstrations: progress, checkpoints, tables, a report.

Example: cmedirl train --env Pendulum-v1 --demos pool.npz --method me-ddpg --seeds 8

The same command goes on where it was stopped. More methods, numbers of demonstrations or seeds
train what is missing.
"""

import argparse
import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from cmedirl_jax.ranges import Size
from cmedirl_jax.runs.config import RunConfig, StudyConfig, of_task
from cmedirl_jax.runs.console.options import read_first
from cmedirl_jax.runs.execute import execute
from cmedirl_jax.runs.report.base import Report
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.training.methods import METHODS


@dataclasses.dataclass(frozen=True)
class Options(RunConfig):
    """What to train. A task brings a budget and settings of its own, where it has some.

    Attributes:
        methods: Which methods to train, beside those that the folder holds already: the paper's
            ddpg, hs-ddpg, me-ddpg and hs-me-ddpg, and others, which a wrong name lists.
        out: Folder of the results; default results/TASK.
    """

    methods: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--method",))] = ("hs-me-ddpg",)
    seeds: Size = 8


def default(arguments: Sequence[str]) -> Options:
    """The options of the task that these arguments name."""
    task = of_task(_read_first(arguments).env)
    return Options(env=task.env, max_steps=task.max_steps, settings=task.settings)


def run(options: Options, arguments: Sequence[str]) -> int:
    """Run the command; returns its exit code.

    Args:
        options: what the arguments say.
        arguments: they tell a default number of demonstrations from one that is meant.
    """
    fewer_will_do = not _read_first(arguments).n_demos_given
    return execute("cmedirl", study(options), _report, fewer_will_do=fewer_will_do)


def study(options: Options) -> StudyConfig:
    """The run's whole configuration: the experts are the task's."""
    given = {each.name: getattr(options, each.name) for each in dataclasses.fields(RunConfig)}
    out = options.out or Path("results") / re.sub(r"[^\w.-]", "-", options.env)
    # The tables keep the methods that the folder holds already.
    methods = dict.fromkeys((*_methods_in(out), *options.methods))
    return dataclasses.replace(
        of_task(options.env), **{**given, "out": out, "methods": tuple(methods)}
    )


def _methods_in(folder: Path) -> list[str]:
    if not (folder / "config.json").is_file():
        return []
    methods = run_folder.read(folder)["config"].get("methods", [])
    return [method for method in methods if method in METHODS]


def _report(folder: Path) -> Report:
    # Matplotlib and scipy take a second to import: a refusal does not wait for them.
    from cmedirl_jax.runs.report import report

    return report.write(folder)


def _read_first(arguments: Sequence[str]) -> argparse.Namespace:
    return read_first(arguments, env=StudyConfig.env)
