"""`python -m experiments.compare FOLDER`: each cell of a run against one of them, seed by seed.

Seeds are paired: seed i of every method draws the same networks, starts and noise. Differences are
therefore taken within pairs. Intervals are bootstrapped over pairs; p-values come from flipping the
signs of pairs, and are adjusted for the number of cells by Holm's method.
"""

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import polars as pl
import scipy.stats
import tyro
from rich import box
from rich.table import Table

from cmedirl_jax import envs
from cmedirl_jax.runs import statistics
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.statistics import SeedStatistics
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import outputs, tables

MEASURES: dict[str, Callable[[SeedStatistics, int], np.ndarray]] = {
    "convergence_env_step": lambda seeds, most: np.minimum(seeds.convergence_env_step, most),
    "area": lambda seeds, most: seeds.area,
    "final_return": lambda seeds, most: seeds.final_return,
}
"""The measures compared. A seed that never converged counts as converged at the last step."""

RESAMPLES = 9_999


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run, and against which of its cells.

    Attributes:
        folder: A run's folder.
        against: The method that every other is compared with, at the same number of demonstrations
            where it has several.
        out: A CSV file for the table.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    against: str = "ddpg"
    out: Path | None = None


@ending.in_a_line("compare")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = tyro.cli(
        Options, prog="python -m experiments.compare", description=__doc__, args=arguments
    )
    outputs.check("out", options.out)
    table = compare(options.folder, options.against)
    screen.show(screen.console(), shown(table, options.against))
    if options.out is not None:
        outputs.write(options.out, table.write_csv().encode())
    return 0


def compare(folder: Path, against: str) -> pl.DataFrame:
    """The paired differences of a finished run's cells to the cell of the method `against`.

    Raises:
        UserError: if the folder holds no run, a damaged one, one whose cells end at different
            steps, a single seed, no cell of that method, or none to compare with it.
    """
    config = run_folder.read(folder)["config"]
    with _undamaged(folder):
        episodes, seeds_count = config["max_episodes"], int(config["seeds"])
    if episodes is not None:
        raise UserError(f"{folder}: a run over episodes, whose seeds end at different steps")
    if seeds_count < 2:
        raise UserError(f"{folder}: one seed has no interval")
    with _undamaged(folder):
        most, threshold = int(config["max_steps"]), envs.make(config["env"]).spec.reward_threshold
        cells = _seed_statistics(tables.read(folder, config), threshold)
        for (method, _), seeds in cells.items():
            if seeds.area.size != seeds_count or not np.isfinite(seeds.area).all():
                raise UserError(
                    f"{folder}: {method} has no finite returns of {seeds_count} seeds; finish the "
                    "run first"
                )
    pairs = _pairs(folder, cells, against)
    rows = []
    for name, measure in MEASURES.items():
        differences = [
            {
                "method": method,
                "n_demos": n_demos,
                "measure": name,
                **_paired(measure(seeds, most), measure(reference, most)),
            }
            for (method, n_demos), (seeds, reference) in pairs.items()
        ]
        adjusted = holm(np.array([row["p_value"] for row in differences]))
        rows += [row | {"p_holm": p} for row, p in zip(differences, adjusted, strict=True)]
    return pl.DataFrame(rows)


def _pairs(
    folder: Path, cells: dict[tuple[str, int], SeedStatistics], against: str
) -> dict[tuple[str, int], tuple[SeedStatistics, SeedStatistics]]:
    """Each cell of another method, and the cell of the method `against` that it is compared with.

    Raises:
        UserError: if there is no cell of that method, or none to compare with it.
    """
    references = {n_demos: seeds for (method, n_demos), seeds in cells.items() if method == against}
    if not references:
        methods = ", ".join(sorted({method for method, _ in cells}))
        raise UserError(f"--against: {folder} holds no {against!r}; its methods are {methods}")
    only = next(iter(references.values())) if len(references) == 1 else None
    pairs = {}
    for (method, n_demos), seeds in cells.items():
        reference = references.get(n_demos, only)
        if method != against and reference is not None:
            pairs[method, n_demos] = seeds, reference
    if not pairs:
        raise UserError(f"{folder}: holds no method beside {against} to compare with it")
    return pairs


@contextlib.contextmanager
def _undamaged(folder: Path) -> Iterator[None]:
    """Turn any error about a configuration's values into a user's error."""
    try:
        yield
    except (LookupError, TypeError, ValueError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"{folder}: holds a damaged file ({reason})") from error


def holm(p_values: np.ndarray) -> np.ndarray:
    """Holm's (1979) adjusted p-values, `[tests]`."""
    order = np.argsort(p_values)
    scaled = p_values[order] * np.arange(p_values.size, 0, -1)
    adjusted = np.empty_like(p_values)
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return adjusted


def _seed_statistics(
    run_tables: dict[str, pl.DataFrame], threshold: float
) -> dict[tuple[str, int], SeedStatistics]:
    """The statistics of the seeds of every cell whose method acts."""
    by_cell = ["method", "n_demos"]
    diverged = {
        cell: rows.sort("seed")["diverged"].to_numpy()
        for cell, rows in run_tables["seeds"].partition_by(by_cell, as_dict=True).items()
    }
    evaluations = run_tables["evaluations"].partition_by(by_cell, as_dict=True)
    return {
        (method, n_demos): statistics.of_seeds(rows, diverged[method, n_demos], threshold)
        for (method, n_demos), rows in evaluations.items()
        if rows["env_step"].max() != 0
    }


def _paired(values: np.ndarray, reference: np.ndarray) -> dict[str, Any]:
    difference = values - reference
    interval = statistics.mean(difference)
    test = scipy.stats.permutation_test(
        (values, reference),
        lambda x, y, axis: np.mean(x - y, axis=axis),
        permutation_type="samples",
        n_resamples=RESAMPLES,
        vectorized=True,
        rng=np.random.default_rng(0),
    )
    return {
        "seeds": difference.size,
        "difference": interval.estimate,
        "difference_low": interval.low,
        "difference_high": interval.high,
        "p_value": float(test.pvalue),
    }


def shown(table: pl.DataFrame, against: str) -> Table:
    """The differences as a table for the screen, a row per cell."""
    printed = Table(title=f"mean paired difference to {against}; 95% intervals", box=box.SIMPLE)
    printed.add_column("method")
    printed.add_column("N_T", justify="right")
    for measure in MEASURES:
        printed.add_column(measure.replace("_", " "), justify="right")
        printed.add_column("p (Holm)", justify="right")
    for (method, n_demos), group in table.group_by("method", "n_demos", maintain_order=True):
        row = []
        for paired in group.iter_rows(named=True):
            form = "{:+,.0f}" if paired["measure"] == "convergence_env_step" else "{:+.1f}"
            numbers = (paired[f"difference{end}"] for end in ("", "_low", "_high"))
            row += ["{} [{}, {}]".format(*map(form.format, numbers)), f"{paired['p_holm']:.4f}"]
        printed.add_row(str(method), str(n_demos) if n_demos else "-", *row)
    return printed


if __name__ == "__main__":
    sys.exit(main())
