"""`python -m experiments.run_grid`: train the study, print its summary, draw its figures."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from cmedirl_jax.runs.cluster import processes
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.console import ending
from cmedirl_jax.runs.console.options import read_first
from cmedirl_jax.runs.execute import execute
from cmedirl_jax.runs.report.base import Report
from experiments import presets


@ending.in_a_line("run_grid")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    config = parse(arguments)
    fewer_will_do = not _read_first(arguments).n_demos_given

    def work() -> int:
        return execute("run_grid", config, _report, fewer_will_do=fewer_will_do)

    processes.check(config.cluster)
    if not config.cluster.several:
        return work()
    if not processes.is_worker():
        return processes.supervise("experiments.run_grid", arguments)
    return processes.guarded("run_grid", work)


def _report(folder: Path) -> Report:
    # Matplotlib and scipy take a second to import: a refusal does not wait for them.
    from experiments import report

    return report.report(folder)


def parse(arguments: Sequence[str]) -> StudyConfig:
    """The configuration: the preset's, with whatever else the command line says."""
    first = _read_first(arguments)
    return tyro.cli(
        StudyConfig,
        prog="python -m experiments.run_grid",
        description=__doc__,
        default=presets.preset(first.preset, first.grid, first.env),
        args=list(arguments),
    )


def _read_first(arguments: Sequence[str]) -> argparse.Namespace:
    return read_first(arguments, preset="tuned", grid="main", env=presets.CAR)


if __name__ == "__main__":
    sys.exit(main())
