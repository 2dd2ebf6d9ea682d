"""The summary of a run: a row for each cell."""

import polars as pl

from cmedirl_jax.runs import statistics
from cmedirl_jax.training.methods import METHODS


def summarise(
    tables: dict[str, pl.DataFrame], threshold: float, max_episodes: int | None
) -> pl.DataFrame:
    """A row for each cell, in the tables' order; see `statistics.summarise`."""
    labels = list(statistics.LABELS)
    seeds = tables["seeds"].partition_by(labels, as_dict=True)
    return pl.DataFrame(
        [
            statistics.summarise(
                evaluations,
                seeds[cell],
                threshold,
                max_episodes,
                interacts=METHODS[evaluations["method"][0]].interacts,
            )
            for cell, evaluations in tables["evaluations"]
            .partition_by(labels, as_dict=True, maintain_order=True)
            .items()
        ],
        infer_schema_length=None,
    )


def cell_label(method: str, n_demos: int) -> str:
    """A cell's name as a reader is told it."""
    return f"{method} (N_T {n_demos})" if n_demos else method
