"""`python -m experiments.report FOLDER`: a run's tables, summary, verdicts, figures and page."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import polars as pl
import tyro

from cmedirl_jax.runs import statistics
from cmedirl_jax.runs.console import ending, screen, streams
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.storage import cells, outputs, tables
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.training.methods import METHODS
from experiments import claims, figures, page, pooled, verdicts
from experiments.pooled import Run


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


class Report(NamedTuple):
    """What became of a report.

    Attributes:
        summary: a row for each cell.
        wrong: a line for each figure that could not be drawn.
    """

    summary: pl.DataFrame
    wrong: list[str]


def report(folder: Path, redraw: bool = False) -> Report:
    """Write the tables, summary, verdicts, figures and page of the cells of config.json.

    The verdicts wait until every cell is finished; there are none of seeds that are not watched for
    as long.

    A file that would be as it is stays untouched; a figure is drawn if the summary has changed, it
    is gone, or `redraw` says so.

    Raises:
        UserError: if the folder holds no finished cell of a run, or a damaged one.
        OSError: if a file cannot be written.
    """
    written = run_folder.read(folder)
    config = written["config"]
    run_tables = tables.read(folder, config)
    threshold, ends = run_folder.solved(folder, written), pooled.lifetime(config)
    summary = summarise(run_tables, threshold, config["max_episodes"])
    tables.write(folder, run_tables)
    # Figures and verdicts of another summary go before this one comes: those there belong to it.
    path, content = folder / "summary.csv", summary.write_csv().encode()
    if not path.is_file() or path.read_bytes() != content:
        for figure in (folder / "figures").glob("*.*"):
            figure.unlink()
        for name in ("claims.md", "report.html"):
            (folder / name).unlink(missing_ok=True)
    outputs.write(path, content)
    files = figures.files(folder / "figures", summary)
    wrong = []
    if redraw or not all(file.exists() for of_figure in files.values() for file in of_figure):
        figures.draw(
            folder / "figures",
            run_tables,
            summary,
            threshold,
            wrong.append,
            by_episodes=ends.episodes is not None,
        )
    # Verdicts, of a run that is whole.
    judged = []
    alike = config["seeds"] > 1 and not ends.mixed
    if alike and summary["seeds"].to_list() == [config["seeds"]] * _asked(config):
        runs = claims.of_one_page([Run(folder, config, threshold, run_tables)])
        judged = verdicts.judge(runs)
        outputs.write(folder / "claims.md", claims.page(runs, judged).encode())
    pictures = {name: of_figure[0] for name, of_figure in files.items()}
    text = page.page(
        config, summary, judged, pictures, written["versions"], ends.episodes is not None
    )
    outputs.write(folder / "report.html", text.encode())
    return Report(summary, wrong)


def _asked(config: dict[str, Any]) -> int:
    """How many cells a configuration asks for."""
    return len(cells.asked(config["methods"], config["n_demos"]))


def summarise(
    run_tables: dict[str, pl.DataFrame], threshold: float, max_episodes: int | None
) -> pl.DataFrame:
    """A row for each cell, in the tables' order; see `statistics.summarise`."""
    labels = list(statistics.LABELS)
    seeds = run_tables["seeds"].partition_by(labels, as_dict=True)
    return pl.DataFrame(
        [
            statistics.summarise(
                evaluations,
                seeds[cell],
                threshold,
                max_episodes,
                interacts=METHODS[evaluations["method"][0]].interacts,
            )
            for cell, evaluations in run_tables["evaluations"]
            .partition_by(labels, as_dict=True, maintain_order=True)
            .items()
        ],
        infer_schema_length=None,
    )


if __name__ == "__main__":
    sys.exit(main())
