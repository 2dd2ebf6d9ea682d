"""A cell's result as rows of the run's tables."""

from typing import Any

import numpy as np
import polars as pl
import polars.selectors as cs

from cmedirl_jax.runs.cells.cell import CellResult
from cmedirl_jax.runs.cells.gymnasium_replay import Replay


def rows(
    result: CellResult,
    cell: dict[str, Any],
    *,
    best_return: np.ndarray,
    replay: Replay,
    expert_steps: int,
) -> dict[str, pl.DataFrame]:
    """The rows that a finished cell adds to each table.

    Args:
        result: the cell.
        cell: its columns `expert`, `method` and `n_demos`.
        best_return: `[seeds]`, of each seed's best policy on fresh starts.
        replay: of the same policies.
        expert_steps: environment steps that the experts were trained for.
    """
    labels = [pl.lit(value).alias(name) for name, value in cell.items()]

    def labelled(columns: dict[str, Any]) -> pl.DataFrame:
        # NaN is 'no update yet'.
        return (
            pl.DataFrame(columns).select(*labels, pl.all()).with_columns(cs.float().fill_nan(None))
        )

    evaluations = pl.concat(
        pl.DataFrame(
            {
                "protocol": [found.protocol] * len(found.seed),
                "seed": found.seed.astype(np.int32),
                "env_step": found.env_step.astype(np.int32),
                "episode": found.episode.astype(np.int32),
                **{name: np.asarray(x) for name, x in found.evaluation._asdict().items()},
                **found.means._asdict(),
            }
        )
        for found in result.evaluations
    ).sort("seed", "env_step", maintain_order=True)
    episodes = result.episodes
    order = np.lexsort((episodes.episode, episodes.seed))
    count = len(result.env_steps)
    difference = np.abs(replay.gymnasium_return - replay.jax_return).max(axis=1)
    finished = np.zeros(count, np.int32)
    np.maximum.at(finished, episodes.seed, episodes.episode.astype(np.int32))
    return {
        "evaluations": labelled(evaluations.to_dict(as_series=True)),
        "episodes": labelled(
            {
                "seed": episodes.seed[order].astype(np.int32),
                "episode": episodes.episode[order].astype(np.int32),
                "env_step": episodes.env_step[order].astype(np.int32),
                "return": episodes.episode_return[order].astype(np.float32),
                "length": episodes.length[order].astype(np.int32),
                "terminated": episodes.terminated[order].astype(bool),
            }
        ),
        "seeds": labelled(
            {
                "seed": np.arange(count, dtype=np.int32),
                "env_steps": result.env_steps.astype(np.int32),
                "episodes": finished,
                "demonstration_steps": result.demonstration_steps.astype(np.int32),
                "expert_steps": np.full(count, expert_steps, np.int64),
                "diverged": result.diverged,
                "best_return": best_return.astype(np.float32),
                "gymnasium_return": replay.gymnasium_return.mean(axis=1),
                "gymnasium_difference": difference,
            }
        ),
    }
