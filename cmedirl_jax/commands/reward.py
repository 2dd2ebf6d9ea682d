"""Say whether the rewards that a run has learned are worth keeping: a report card per method.

Example: cmedirl reward results/tuned

Distances and correlations need the task's own reward, in JAX; the rest is of demonstrations and
policies alone. The card is written to RUN/reward/ too, with a row for each learner.
"""

import dataclasses
import io
from pathlib import Path
from typing import Annotated, Any

import polars as pl
import tyro
from rich import box
from rich.table import Table

from cmedirl_jax.runs import start
from cmedirl_jax.runs.console import compile_cache, screen, streams
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import outputs, tables


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run.

    Attributes:
        folder: A run's folder. Cells that are not finished are left out.
    """

    folder: Annotated[Path, tyro.conf.Positional]


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    folder, config = options.folder, run_folder.read(options.folder)["config"]
    compile_cache.use_cache()
    start.devices()
    # scipy takes a second to import: a refusal does not wait for it.
    from cmedirl_jax.runs import drawing
    from cmedirl_jax.runs.report import reward_cards

    with run_folder.held(folder):
        cards = reward_cards.of_run(folder)
        summary = reward_cards.summarise(cards.rows, tables.read(folder, config)["seeds"])
        buffer, to = io.BytesIO(), folder / run_folder.REWARD
        cards.rows.write_parquet(buffer)
        outputs.write(to / "seeds.parquet", buffer.getvalue())
        outputs.write(to / "summary.csv", summary.write_csv().encode())
        if cards.maps is not None:
            drawing.save(cards.maps, [to / "maps.png", to / "maps.svg"], streams.complain)
    console = screen.console()
    screen.show(console, _table(summary))
    for measure in summary["measure"].unique(maintain_order=True):
        screen.say(console, f"{measure}: {reward_cards.MEASURES[measure]}")
    screen.say(console, f"Report card: {to}")
    return 0


def _table(summary: pl.DataFrame) -> Table:
    """A row for each cell, a column for each measure."""
    seeds = summary["seeds"].max()
    printed = Table(title=f"{seeds} seeds per row; 95% intervals", box=box.SIMPLE)
    measures = summary["measure"].unique(maintain_order=True).to_list()
    for name in ("method", "N_T", *(measure.replace("_", "\n") for measure in measures)):
        printed.add_column(name, justify="left" if name == "method" else "right")
    for (method, n_demos), cell in summary.group_by("method", "n_demos", maintain_order=True):
        found = {row["measure"]: row for row in cell.iter_rows(named=True)}
        cells = [_interval(found[each]) if each in found else "-" for each in measures]
        printed.add_row(str(method), str(n_demos) if n_demos else "-", *cells)
    return printed


def _interval(row: dict[str, Any]) -> str:
    return f"{row['mean']:.2f}\n\\[{row['low']:.2f}, {row['high']:.2f}]"
