"""Finished cells of numbers that mean nothing."""

import polars as pl

from cmedirl_jax.runs.storage import cells


def rows(key):
    """Two evaluations of each seed, and no episode."""
    labels = [
        pl.lit(getattr(key, name)).alias(name) for name in ("study", "expert", "method", "n_demos")
    ]
    numbers = list(key.seed_range)
    same = {"best_evaluation": 0.5, "best_return": 0.5}
    seeds = pl.DataFrame({"seed": numbers, "expert_id": numbers, **same})
    seeds = seeds.select(*labels, pl.all())
    evaluations = pl.concat(seeds.with_columns(env_step=step, return_mean=0.5) for step in (0, 9))
    return {"evaluations": evaluations, "episodes": seeds.head(0), "seeds": seeds}


def seeds_table(count, **columns):
    """Rows of seeds.parquet of seeds that share no expert; `columns` replace some."""
    return pl.DataFrame(
        {
            "expert": "each",
            "seed": range(count),
            "expert_id": range(count),
            "expert_return": [94.0] * count,
            "env_steps": [500] * count,
            "episodes": [7 + seed for seed in range(count)],
            "demonstration_steps": [90] * count,
            "expert_steps": [4_000] * count,
            "diverged": [False] * count,
            "best_evaluation": [91.0 + 2.0 * seed for seed in range(count)],
            "best_return": [90.0 + 2.0 * seed for seed in range(count)],
            "gymnasium_return": [91.0 + seed for seed in range(count)],
            "gymnasium_difference": [0.001 * seed for seed in range(count)],
            **columns,
        },
        schema_overrides={"expert_id": pl.Int32, "expert_return": pl.Float64},
    )


def save(folder, key, tables=None):
    """Write a cell without policies; returns its folder."""
    cells.save(folder, key, {}, tables or rows(key), {})
    return folder / "cells" / cells.name(key.method, key.n_demos, key.first_seed, key.seeds)
