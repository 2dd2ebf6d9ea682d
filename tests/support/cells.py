"""Finished cells of numbers that mean nothing."""

import polars as pl

from cmedirl_jax.runs.storage import cells


def rows(key):
    """Two evaluations of each seed, and no episode."""
    labels = [
        pl.lit(getattr(key, name)).alias(name) for name in ("study", "expert", "method", "n_demos")
    ]
    seeds = pl.DataFrame({"seed": list(key.seed_range)}).select(*labels, pl.all())
    evaluations = pl.concat(seeds.with_columns(env_step=step, return_mean=0.5) for step in (0, 9))
    return {"evaluations": evaluations, "episodes": seeds.head(0), "seeds": seeds}


def save(folder, key, tables=None):
    """Write a cell without policies; returns its folder."""
    cells.save(folder, key, {}, tables or rows(key), {})
    return folder / "cells" / cells.name(key.method, key.n_demos, key.first_seed, key.seeds)
