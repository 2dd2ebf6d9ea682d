"""`python -m experiments.compare FOLDER ...`: each cell of a study against others, seed by seed.

Every method is compared with one of them at the same number of demonstrations, and with itself at
its largest number. Several folders of one configuration are pooled: other study seeds, other cells.
Differences are of pairs of seeds; see `runs.paired`. The p-values are adjusted for the whole table
by Holm's method.
"""

import dataclasses
import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import polars as pl
import tyro
from rich import box
from rich.table import Table

from cmedirl_jax.runs import paired
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.report.summary import cell_label
from cmedirl_jax.runs.storage import outputs
from experiments import measures, pooled
from experiments.measures import AREA, EPISODES, FINAL, STABLE, STEPS, speed
from experiments.pooled import CellName, CellSeeds


@dataclasses.dataclass(frozen=True)
class Options:
    """Which runs, and against which of their cells.

    Attributes:
        folders: Folders of runs of one configuration, with other study seeds or other cells.
        against: The method that every other is compared with, at the same number of demonstrations
            where it has several.
        out: A CSV file for the table.
    """

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional]
    against: str = "ddpg"
    out: Path | None = None


@ending.in_a_line("compare")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "experiments.compare", __doc__, arguments)
    outputs.check("out", options.out)
    if not options.folders:
        raise UserError("FOLDERS: give the folder of a run")
    console = screen.console()
    table = compare(options.folders, options.against, functools.partial(screen.say, console))
    screen.show(console, shown(table))
    if options.out is not None:
        outputs.write(options.out, table.write_csv().encode())
    return 0


def compare(
    folders: Sequence[Path], against: str, say: Callable[[str], None] = lambda line: None
) -> pl.DataFrame:
    """The paired differences between finished runs' cells, a row for each pair and measure.

    Args:
        folders: of the runs.
        against: a method.
        say: called with a line on the cells that are left out.

    Raises:
        UserError: as `pooled.load` and `pooled.pool`; for a single seed; if there is no cell of the
            method `against`, or none to compare with it.
    """
    runs = pooled.pool([pooled.load(folder) for folder in folders])
    if runs.config["seeds"] < 2:
        raise UserError(f"{folders[0]}: one seed has no interval")
    rows = []
    pairs = _pairs(folders[0], runs.cells, against)
    for name, other in pairs:
        cell, reference = runs.cells[name], runs.cells[other]
        for measure in (speed(runs), AREA, FINAL, STABLE):
            labels = {"method": name[0], "n_demos": name[1]}
            labels |= {"against": other[0], "against_n_demos": other[1], "measure": measure.name}
            rows.append(labels | measures.difference(measure, (cell, runs), (reference, runs)))
    left_out = [name for name in runs.cells if not any(name in pair for pair in pairs)]
    if left_out:
        names = ", ".join(cell_label(*name) for name in left_out)
        say(f"Left out, since they never act or {against} has no one cell for them: {names}")
    adjusted = paired.holm(np.array([row["p_value"] for row in rows]))
    return pl.DataFrame([row | {"p_holm": p} for row, p in zip(rows, adjusted, strict=True)])


def _pairs(
    folder: Path, cells: dict[CellName, CellSeeds], against: str
) -> list[tuple[CellName, CellName]]:
    """Each cell and the one that it is compared with, methods first.

    Raises:
        UserError: if there is no cell of the method `against`, or none to compare with it.
    """
    acting = [name for name, cell in cells.items() if cell.evaluations["env_step"].max() != 0]
    references = {n_demos: (method, n_demos) for method, n_demos in acting if method == against}
    if not references:
        methods = ", ".join(sorted({method for method, _ in acting}))
        raise UserError(f"--against: {folder} holds no {against!r}; its methods are {methods}")
    only = next(iter(references.values())) if len(references) == 1 else None
    between = [
        (name, reference)
        for name in acting
        if name[0] != against and (reference := references.get(name[1], only)) is not None
    ]
    most = {method: max(n for other, n in acting if other == method) for method, _ in acting}
    across = [(name, (name[0], most[name[0]])) for name in acting if name[1] < most[name[0]]]
    if not between + across:
        raise UserError(f"{folder}: holds no method beside {against} to compare with it")
    return between + across


_FORMS = {one.name: one.form for one in (STEPS, EPISODES, AREA, FINAL, STABLE)}


def shown(table: pl.DataFrame) -> Table:
    """The differences as a table for the screen, a row for each pair of cells."""
    printed = Table(title="mean paired differences; 95% intervals, Holm's p", box=box.SIMPLE)
    printed.add_column("cell")
    printed.add_column("against")
    for name in table["measure"].unique(maintain_order=True):
        printed.add_column(name.replace("_", " "), justify="right")
    cells = ["method", "n_demos", "against", "against_n_demos"]
    for group in table.partition_by(cells, maintain_order=True):
        row = []
        for found in group.iter_rows(named=True):
            form = _FORMS[found["measure"]].format
            mean, low, high = (form(found[f"difference{end}"]) for end in ("", "_low", "_high"))
            row.append(f"{mean} \\[{low}, {high}]\np {found['p_holm']:.4f}, {found['equivalence']}")
        method, n_demos, against, other = group.select(cells).row(0)
        printed.add_row(cell_label(method, n_demos), cell_label(against, other), *row)
    return printed


if __name__ == "__main__":
    sys.exit(main())
