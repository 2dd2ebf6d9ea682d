"""`python -m experiments.compare FOLDER ...`: each cell of a study against others, seed by seed.

Every method is compared with one of them at the same number of demonstrations, and with itself at
its largest number. Several folders of one configuration are pooled: other study seeds, other cells.
Differences are of pairs of seeds; see `runs.paired`. The p-values are adjusted for the whole table
by Holm's method.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import polars as pl
import tyro
from rich import box
from rich.table import Table

from cmedirl_jax.runs import paired
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs
from experiments import pooled
from experiments.measures import AREA, FINAL, STABLE, STEPS, Measure
from experiments.pooled import CellName, CellSeeds

MEASURES = (STEPS, AREA, FINAL, STABLE)


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
    options = tyro.cli(
        Options, prog="python -m experiments.compare", description=__doc__, args=arguments
    )
    outputs.check("out", options.out)
    if not options.folders:
        raise UserError("FOLDERS: give the folder of a run")
    table = compare(options.folders, options.against)
    screen.show(screen.console(), shown(table))
    if options.out is not None:
        outputs.write(options.out, table.write_csv().encode())
    return 0


def compare(folders: Sequence[Path], against: str) -> pl.DataFrame:
    """The paired differences between finished runs' cells, a row for each pair and measure.

    Raises:
        UserError: as `pooled.load` and `pooled.pool`; if the seeds end at different steps; for a
            single seed; if there is no cell of the method `against`, or none to compare with it.
    """
    runs = pooled.pool([pooled.load(folder) for folder in folders])
    if runs.by_episodes:
        raise UserError(f"{folders[0]}: a run over episodes, whose seeds end at different steps")
    if runs.config["seeds"] < 2:
        raise UserError(f"{folders[0]}: one seed has no interval")
    rows = []
    for name, other in _pairs(folders[0], runs.cells, against):
        cell, reference = runs.cells[name], runs.cells[other]
        for measure in MEASURES:
            labels = {"method": name[0], "n_demos": name[1]}
            labels |= {"against": other[0], "against_n_demos": other[1], "measure": measure.name}
            rows.append(labels | _difference(measure, cell, reference, runs.most))
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


def _difference(
    measure: Measure, cell: CellSeeds, reference: CellSeeds, most: int
) -> dict[str, Any]:
    mine, others = pooled.aligned(cell, reference)
    found = paired.compare(
        measure.of(cell, most)[mine],
        measure.of(reference, most)[others],
        pooled.clusters(cell, reference, mine, others),
    )
    return {
        "seeds": found.pairs,
        "difference": found.mean.estimate,
        "difference_low": found.mean.low,
        "difference_high": found.mean.high,
        "p_value": found.p_value,
        "equivalence": paired.equivalence(found, measure.margin),
    }


def shown(table: pl.DataFrame) -> Table:
    """The differences as a table for the screen, a row for each pair of cells."""
    printed = Table(title="mean paired differences; 95% intervals, Holm's p", box=box.SIMPLE)
    printed.add_column("cell")
    printed.add_column("against")
    for measure in MEASURES:
        printed.add_column(measure.name.replace("_", " "), justify="right")
    cells = ["method", "n_demos", "against", "against_n_demos"]
    for (method, n_demos, against, other), group in table.group_by(cells, maintain_order=True):
        row = []
        for measure, found in zip(MEASURES, group.iter_rows(named=True), strict=True):
            form = measure.form.format
            mean, low, high = (form(found[f"difference{end}"]) for end in ("", "_low", "_high"))
            row.append(f"{mean} \\[{low}, {high}]\np {found['p_holm']:.4f}, {found['equivalence']}")
        printed.add_row(_name(method, n_demos), _name(against, other), *row)
    return printed


def _name(method: Any, n_demos: Any) -> str:
    return f"{method}, {n_demos}" if n_demos else str(method)


if __name__ == "__main__":
    sys.exit(main())
