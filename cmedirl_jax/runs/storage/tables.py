"""The run's tables: a cell's result as rows, and the rows of the cells that were asked for."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import polars.selectors as cs

from cmedirl_jax.runs.cells.cell import CellResult
from cmedirl_jax.runs.cells.gymnasium_replay import ReplayedReturns
from cmedirl_jax.runs.cells.pools import LearnersPool
from cmedirl_jax.runs.cells.record import Means
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import cells, outputs
from cmedirl_jax.runs.storage.cells import TABLES, CellKey, SavedCell

FILES = tuple(f"{name}.parquet" for name in TABLES)


def rows(
    result: CellResult,
    key: CellKey,
    *,
    best_return: np.ndarray,
    replay: ReplayedReturns | None,
    pool: LearnersPool | None,
) -> dict[str, pl.DataFrame]:
    """The rows of a finished cell in each table.

    Args:
        result: the cell.
        key: which cell it is.
        best_return: `[seeds]`, of each seed's best policy on fresh starts.
        replay: returns of the same policies in Gymnasium and in JAX; None where there is none.
        pool: of the demonstrations; None for a method without.
    """
    labels = [
        pl.lit(key.study, pl.Int64).alias("study"),
        *(pl.lit(getattr(key, name)).alias(name) for name in ("expert", "method", "n_demos")),
    ]

    def labelled(table: pl.DataFrame) -> pl.DataFrame:
        # NaN means 'no update yet'.
        return table.select(*labels, pl.all()).with_columns(cs.float().fill_nan(None))

    return {
        "evaluations": labelled(_evaluations(result, key.first_seed)),
        "episodes": labelled(_episodes(result, key.first_seed)),
        "seeds": labelled(_seeds(result, key, best_return, replay, pool)),
    }


def _evaluations(result: CellResult, first_seed: int) -> pl.DataFrame:
    return pl.concat(
        pl.DataFrame(
            {
                "protocol": [rows.protocol] * len(rows.seed),
                "seed": (first_seed + rows.seed).astype(np.int32),
                "env_step": rows.env_step.astype(np.int32),
                "episode": rows.episode.astype(np.int32),
                **{name: np.asarray(x) for name, x in rows.evaluation._asdict().items()},
                **means(rows.means),
            }
        )
        for rows in result.evaluations
    ).sort("seed", "env_step", maintain_order=True)


def means(means: Means) -> dict[str, np.ndarray]:
    """The means as columns, with the deviation of r_D in place of its mean square."""
    columns = means._asdict()
    variance = columns.pop("r_d_mean_square") - means.r_d_mean**2
    return {**columns, "r_d_std": np.sqrt(np.maximum(variance, 0.0))}


def _episodes(result: CellResult, first_seed: int) -> pl.DataFrame:
    episodes = result.episodes
    order = np.lexsort((episodes.episode, episodes.seed))
    return pl.DataFrame(
        {
            "seed": (first_seed + episodes.seed[order]).astype(np.int32),
            "episode": episodes.episode[order].astype(np.int32),
            "env_step": episodes.env_step[order].astype(np.int32),
            "return": episodes.episode_return[order].astype(np.float32),
            "length": episodes.length[order].astype(np.int32),
            "terminated": episodes.terminated[order].astype(bool),
        }
    )


def _seeds(
    result: CellResult,
    key: CellKey,
    best_return: np.ndarray,
    replay: ReplayedReturns | None,
    pool: LearnersPool | None,
) -> pl.DataFrame:
    episodes, count = result.episodes, len(result.env_steps)
    mine = slice(key.first_seed, key.first_seed + count)
    unknown = np.full(count, np.nan)
    expert = np.full(count, -1) if pool is None else pool.expert[mine]
    finished = np.zeros(count, np.int32)
    np.maximum.at(finished, episodes.seed, episodes.episode.astype(np.int32))
    return pl.DataFrame(
        {
            "seed": np.array(key.seed_range, np.int32),
            # No expert, or no single one.
            "expert_id": pl.Series(expert, dtype=pl.Int32).replace(-1, None),
            "expert_return": unknown if pool is None else pool.expert_return[mine],
            "env_steps": result.env_steps.astype(np.int32),
            "episodes": finished,
            "demonstration_steps": result.demonstration_steps.astype(np.int32),
            "expert_steps": np.zeros(count, np.int64)
            if pool is None
            else pool.expert_steps[mine].astype(np.int64),
            "diverged": result.diverged,
            "best_evaluation": _best_evaluation(result),
            "best_return": best_return.astype(np.float32),
            "gymnasium_return": unknown if replay is None else replay.gymnasium_return.mean(axis=1),
            "gymnasium_difference": unknown
            if replay is None
            else np.abs(replay.gymnasium_return - replay.jax_return).max(axis=1),
        }
    )


def _best_evaluation(result: CellResult) -> np.ndarray:
    """`[seeds]`, the highest of each seed's evaluations by steps: the paper's best policy."""
    best = np.full(len(result.env_steps), -np.inf, np.float32)
    for rows in result.evaluations:
        if rows.protocol == "steps":
            np.fmax.at(best, rows.seed, np.asarray(rows.evaluation.return_mean, np.float32))
    return best


def of_cells(
    saved: Sequence[SavedCell], asked: Iterable[tuple[str, int]], seeds: int
) -> dict[str, pl.DataFrame]:
    """The tables of the cells that were asked for, as far as they are finished.

    Args:
        saved: the run's finished cells.
        asked: method and number of demonstrations of each, in the tables' order.
        seeds: how many seeds of each.
    """
    chosen = [
        cell
        for method, n_demos in asked
        for cell in sorted(saved, key=lambda cell: cell.key.first_seed)
        if (cell.key.method, cell.key.n_demos) == (method, n_demos) and cell.key.first_seed < seeds
    ]
    if not chosen:
        return {}
    return {
        name: pl.concat(cell.table(name) for cell in chosen).filter(pl.col("seed") < seeds)
        for name in TABLES
    }


def read(folder: Path, config: dict[str, Any]) -> dict[str, pl.DataFrame]:
    """The tables that a run's configuration asks for, from its cells, each of which is checked.

    Args:
        folder: the run's.
        config: `methods`, `n_demos` and `seeds` say which cells.

    Raises:
        UserError: if no such cell is finished, or one is damaged.
    """
    try:
        asked = cells.asked(config["methods"], config["n_demos"])
    except (LookupError, TypeError, ValueError) as error:
        raise UserError(f"{folder}: its config.json names no cells ({error!r})") from error
    run_tables = of_cells(cells.finished(folder), asked, config["seeds"])
    if not run_tables:
        raise UserError(f"{folder}: holds no finished cell of a run")
    if missing := {"expert_id", "best_evaluation"} - set(run_tables["seeds"].columns):
        raise UserError(
            f"{folder}: an older version wrote its cells, without {', '.join(sorted(missing))}; "
            "read them with that version, or train them again in another folder"
        )
    return run_tables


def write(folder: Path, tables: dict[str, pl.DataFrame]) -> None:
    """Write the run's tables; those that are there already stay untouched."""
    for name, table in tables.items():
        outputs.write_table(folder / f"{name}.parquet", table)
