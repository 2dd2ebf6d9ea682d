"""Finished runs of hand-made curves."""

import dataclasses

import numpy as np
import polars as pl

from cmedirl_jax.runs import validation
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage.cells import CellKey
from experiments.presets import PRESETS
from tests.support import cells as cells_of

STEPS = np.array([0, 100, 200])
SEEDS = 6


def save(folder, method, n_demos, curves, diverged=()):
    """A finished cell whose seeds have these returns at `STEPS`."""
    key = CellKey(0, "best" if n_demos else "none", method, n_demos, 0, len(curves))
    labels = {"method": method, "n_demos": n_demos}
    evaluations = pl.concat(
        pl.DataFrame(
            {
                **labels,
                "protocol": "steps",
                "seed": seed,
                "env_step": STEPS[: len(curve)],
                "episode": STEPS[: len(curve)] // 50,
                "return_mean": np.asarray(curve, float),
            }
        )
        for seed, curve in enumerate(curves)
    )
    count = len(curves)
    without = {} if n_demos else {"expert_id": [None] * count, "expert_return": [None] * count}
    seeds = cells_of.seeds_table(
        count, **labels, **without, diverged=np.isin(range(count), diverged)
    )
    rows = {"evaluations": evaluations, "seeds": seeds, "episodes": seeds}
    return cells_of.save(folder, key, rows)


METHODS = ("ddpg", "hs-ddpg", "me-ddpg", "bc", "hs-me-ddpg")


def write_config(folder, **changes):
    options = {"methods": METHODS, "n_demos": (5, 7), "seeds": SEEDS, "max_steps": 200} | changes
    config = dataclasses.replace(PRESETS["smoke"], out=folder, **options)
    with run_folder.opened(folder, validation.describe(config)):
        pass
