"""Finished runs whose policies are untrained."""

import jax
import numpy as np

from cmedirl_jax import networks
from cmedirl_jax.runs.storage import cells, plain
from cmedirl_jax.runs.storage.cells import CellKey
from cmedirl_jax.training.settings import Settings
from tests.support import cells as cells_of
from tests.support import curves, pools

SEEDS = 2
METHODS = ("ddpg", "hs-ddpg")


def save(folder):
    """A run of `METHODS` with 5 and 7 demonstrations, `SEEDS` learners each."""
    curves.write_config(folder, methods=METHODS, n_demos=(5, 7), seeds=SEEDS)
    spec, settings = pools.ENV.spec, Settings()
    init = networks.make(spec, settings.architecture).actor.init
    actors = [init(jax.random.key(seed)) for seed in range(SEEDS)]
    policies = jax.tree.map(lambda *leaves: np.stack(leaves), *actors)
    description = {"task": plain.plain(spec), "settings": plain.plain(settings)}
    for method, n_demos in cells.asked(METHODS, (5, 7)):
        key = CellKey(0, "each" if n_demos else "none", method, n_demos, 0, SEEDS)
        cells.save(folder, key, description, cells_of.rows(key), {"policies": policies})
