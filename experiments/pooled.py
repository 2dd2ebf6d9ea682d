"""The seeds of finished runs of one configuration, cell by cell, over all of their study seeds."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import polars.selectors as cs

from cmedirl_jax.runs import statistics
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.lifetime import lifetime
from cmedirl_jax.runs.report.base import Run
from cmedirl_jax.runs.statistics import SeedStatistics
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import tables

CellName = tuple[str, int]
"""A method and its number of demonstrations, 0 for one without."""

BUDGET = (
    *("max_steps", "max_episodes"),
    *("evaluate_every", "evaluate_every_episodes", "evaluation_starts_episodes"),
)
"""The options that say how long seeds live and when they are evaluated."""
_MAY_DIFFER = {"seed", "group", *run_folder.NOT_COMPARED} - {"seeds"}


class CellSeeds(NamedTuple):
    """A cell's seeds, arrays `[seeds]`.

    Attributes:
        pair: what a seed is paired by: its study's seed and its own number.
        expert: whose demonstrations it has, -1 for none or several. Studies have experts of their
            own, unless all read one file of demonstrations.
        diverged: bool.
        statistics: of its evaluations by steps.
        expert_return: of its expert on the evaluation starts; NaN if it has none.
        best_evaluation: the highest of its evaluations.
        best_return: of the same policy on fresh starts.
        evaluations: all rows of the cell's seeds in evaluations.parquet.
    """

    pair: np.ndarray
    expert: np.ndarray
    diverged: np.ndarray
    statistics: SeedStatistics
    expert_return: np.ndarray
    best_evaluation: np.ndarray
    best_return: np.ndarray
    evaluations: pl.DataFrame

    @property
    def study(self) -> np.ndarray:
        """`[seeds]`, the study's seed of each."""
        return self.pair // 2**32


class Pooled(NamedTuple):
    """Runs that differ in their study's seed and their cells at most.

    Attributes:
        cells: by name, in the order of the runs' tables.
        config: of the first run.
        steps: the last environment step that a seed can reach.
        episodes: after which every seed ends, at different steps; None where steps end it.
    """

    cells: dict[CellName, CellSeeds]
    config: dict[str, Any]
    steps: int
    episodes: int | None


def load(folder: Path) -> Run:
    """Read a run.

    Raises:
        UserError: if the folder holds no run, or a damaged one.
    """
    written = run_folder.read(folder)
    config = written["config"]
    with undamaged(folder):
        threshold = run_folder.solved(folder, written)
        return Run(folder, config, threshold, tables.read(folder, config))


def pool(runs: Sequence[Run]) -> Pooled:
    """Pool the cells of runs.

    Raises:
        UserError: if a run is damaged or not finished, the configurations differ, two runs hold the
            same seeds, or the seeds are not watched for as long.
    """
    found: dict[CellName, list[CellSeeds]] = {}
    for run in runs:
        check_alike(runs[0], run)
        with undamaged(run.folder):
            for name, cell in _cells(run).items():
                found.setdefault(name, []).append(cell)
    pooled = {name: _joined(parts) for name, parts in found.items()}
    for (method, _), cell in pooled.items():
        if np.unique(cell.pair).size < cell.pair.size:
            last = runs[-1].folder
            raise UserError(f"{last}: holds seeds of {method} that another folder holds too")
    first = runs[0].config
    with undamaged(runs[0].folder):
        ends = lifetime(first)
    if ends.mixed:
        raise UserError(
            f"{runs[0].folder}: its seeds end by --max-steps or by --max-episodes, whichever comes "
            "first: they are not watched for as long"
        )
    return Pooled(pooled, first, ends.steps, ends.episodes)


def check_alike(first: Run, other: Run, but: Sequence[str] = ()) -> None:
    """Check that two runs have one configuration, whatever their study's seed and their cells.

    Args:
        first: a run.
        other: another one.
        but: options that may differ too.

    Raises:
        UserError: if they have not; it names the option.
    """
    mine, others = run_folder.flat(first.config), run_folder.flat(other.config)
    for name in sorted(mine.keys() | others.keys()):
        if name not in _MAY_DIFFER and name not in but and mine.get(name) != others.get(name):
            raise UserError(
                f"{other.folder}: its {name} is not that of {first.folder}; give runs of one kind"
            )


def _cells(run: Run) -> dict[CellName, CellSeeds]:
    folder, config, threshold, run_tables = run
    by_cell = ["method", "n_demos"]
    seeds = run_tables["seeds"].partition_by(by_cell, as_dict=True)
    study, count = int(config["seed"]), int(config["seeds"])
    cells = {}
    for (method, n_demos), rows in (
        run_tables["evaluations"].partition_by(by_cell, as_dict=True, maintain_order=True).items()
    ):
        of_cell = seeds[method, n_demos].sort("seed")
        found = statistics.of_seeds(
            rows,
            of_cell["diverged"].to_numpy(),
            threshold,
            by_episodes=config["max_episodes"] is not None,
        )
        if found.area.size != count or not np.isfinite(found.area).all():
            raise UserError(
                f"{folder}: {method} has no finite returns of {count} seeds; finish the run first"
            )
        offset = study * 2**32
        own = offset if config.get("demos") is None else 0
        numbers = of_cell.select(
            pl.col("seed").cast(pl.Int64) + offset,
            pl.col("expert_id").cast(pl.Int64) + own,
            cs.starts_with("best_", "expert_return"),
        )
        cells[method, n_demos] = CellSeeds(
            pair=numbers["seed"].to_numpy(),
            expert=numbers["expert_id"].fill_null(-1).to_numpy(),
            diverged=of_cell["diverged"].to_numpy(),
            statistics=found,
            expert_return=numbers["expert_return"].fill_null(np.nan).to_numpy(),
            best_evaluation=numbers["best_evaluation"].to_numpy(),
            best_return=numbers["best_return"].to_numpy(),
            evaluations=rows.with_columns(pair=pl.col("seed").cast(pl.Int64) + offset),
        )
    return cells


def _joined(parts: list[CellSeeds]) -> CellSeeds:
    def column(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    return CellSeeds(
        pair=column("pair"),
        expert=column("expert"),
        diverged=column("diverged"),
        statistics=SeedStatistics(
            *(np.concatenate(leaf) for leaf in zip(*(x.statistics for x in parts), strict=True))
        ),
        expert_return=column("expert_return"),
        best_evaluation=column("best_evaluation"),
        best_return=column("best_return"),
        evaluations=pl.concat(part.evaluations for part in parts),
    )


@contextlib.contextmanager
def undamaged(folder: Path) -> Iterator[None]:
    """Turn any error about a run's values into a user's error."""
    try:
        yield
    except (LookupError, TypeError, ValueError, pl.exceptions.PolarsError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"{folder}: holds a damaged file ({reason})") from error


def aligned(cell: CellSeeds, reference: CellSeeds) -> tuple[np.ndarray, np.ndarray]:
    """Positions `[pairs]` in each cell of the seeds that both have, in the same order."""
    _, mine, others = np.intersect1d(cell.pair, reference.pair, return_indices=True)
    return mine, others


def clusters(
    cell: CellSeeds, reference: CellSeeds, mine: np.ndarray, others: np.ndarray
) -> np.ndarray | None:
    """`[pairs]`, which pairs share an expert; None if neither cell says."""
    for experts in (cell.expert[mine], reference.expert[others]):
        if (experts >= 0).all():
            return experts
    return None
