"""`python -m experiments.report FOLDER`: a run's tables, summary and figures, from its cells."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import polars as pl
import tyro

from cmedirl_jax import envs
from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs import statistics
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import tables
from cmedirl_jax.training.methods import METHODS
from experiments import figures


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run.

    Attributes:
        folder: A run's folder. Cells that are not finished are left out.
    """

    folder: Annotated[Path, tyro.conf.Positional]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = tyro.cli(
        Options, prog="python -m experiments.report", description=__doc__, args=arguments
    )
    folder = options.folder
    try:
        run_folder.read(folder)
        with run_folder.held(folder):
            report(folder, redraw=True)
    except (UserError, OSError) as error:
        print(f"report: {error}", file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    print(f"Tables and figures: {folder}")
    return 0


def report(folder: Path, redraw: bool = False) -> pl.DataFrame:
    """Write the tables, summary and figures of the cells that config.json asks for.

    A file that would be as it is stays untouched; the figures are drawn again if the summary has
    changed, they are gone, or `redraw` says so.

    Returns:
        The summary.

    Raises:
        UserError: if the folder holds no finished cell of a run, or a damaged one.
        OSError: if a file cannot be written.
    """
    config = run_folder.read(folder)["config"]
    run_tables = tables.read(folder, config)
    threshold = envs.make(config["env"]).spec.reward_threshold
    summary = summarise(run_tables, threshold, config["max_episodes"])
    tables.write(folder, run_tables)
    # The summary is written last, so that a run cut off among its figures draws them again.
    path, content = folder / "summary.csv", summary.write_csv().encode()
    same = path.is_file() and path.read_bytes() == content
    if redraw or not same or not (folder / "figures").exists():
        _draw(folder, run_tables, summary, threshold)
    tables.write_if_other(path, content)
    return summary


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


def _draw(
    folder: Path,
    run_tables: dict[str, pl.DataFrame],
    summary: pl.DataFrame,
    threshold: float,
) -> None:
    pool = stored_demonstrations.load(folder)
    expert = None if pool is None else float(demonstrations.returns(pool).mean())
    figures.draw(
        folder / "figures",
        run_tables["evaluations"],
        run_tables["episodes"],
        summary,
        expert,
        threshold,
    )


if __name__ == "__main__":
    sys.exit(main())
