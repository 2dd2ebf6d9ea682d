"""`python -m experiments.report FOLDER`: a run's tables, summary, verdicts, figures and page."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from cmedirl_jax.runs.console import ending, screen, streams
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.report import report as report_lib
from cmedirl_jax.runs.report.base import Report
from cmedirl_jax.runs.storage import folder as run_folder
from experiments import claims


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run.

    Attributes:
        folder: A run's folder. Cells that are not finished are left out.
    """

    folder: Annotated[Path, tyro.conf.Positional]


@ending.in_a_line("report")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code, 1 if a figure could not be drawn."""
    options = read(Options, "experiments.report", __doc__, arguments)
    folder = options.folder
    run_folder.read(folder)
    with run_folder.held(folder):
        wrong = report(folder, redraw=True).wrong
    screen.say(screen.console(), f"Tables and figures: {folder}")
    for line in wrong:
        streams.complain(f"report: {line}")
    return 1 if wrong else 0


def report(folder: Path, redraw: bool = False) -> Report:
    """Write a run's report with the verdicts on the paper's claims; see `report.write`."""
    return report_lib.write(folder, redraw, claims.verdicts_on)


if __name__ == "__main__":
    sys.exit(main())
