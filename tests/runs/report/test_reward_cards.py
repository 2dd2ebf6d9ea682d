"""Report cards of the rewards in a run's folder."""

import shutil

import jax
import numpy as np
import polars as pl
import pytest

from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.report import (
    reward_agreement,
    reward_cards,
    reward_maps,
    reward_samples,
    reward_slices,
)
from cmedirl_jax.runs.storage import cells, plain
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage.cells import CellKey
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings
from tests.support import cells as cells_of
from tests.support import curves, pools

SEEDS = 2


@pytest.fixture(autouse=True)
def small(monkeypatch):
    for module, name, value in (
        (reward_cards, "COMPARED", 32),
        (reward_cards, "DRAWS", 8),
        (reward_cards, "GRID", {2: 9}),
        (reward_samples, "SAMPLED", 64),
        (reward_maps, "POINTS", 9),
    ):
        monkeypatch.setattr(module, name, value)


@pytest.fixture
def folder(tmp_path):
    """A run of two untrained learners in two blocks, each with an expert of two episodes."""
    curves.write_config(tmp_path, methods=("me-ddpg", "ddpg"), n_demos=(2,), seeds=SEEDS)
    pool = pools.scripted(4)
    experts = {"expert": "each", "experts_demonstrating": [0, 1], "experts_trained": 2}
    experts |= {"expert_returns": [97.0, 98.0], "expert_env_steps": 10}
    stored_demonstrations.save(tmp_path, pool._replace(metadata={**pool.metadata, **experts}))
    settings = Settings()
    made = compose.compose(pools.ENV.spec, METHODS["me-ddpg"], settings, 10)
    keys = jax.random.split(jax.random.key(0), SEEDS)
    trees = {
        "policies": jax.jit(jax.vmap(made.agent.init))(keys).actor,
        "rewards": jax.jit(jax.vmap(made.learner.init))(keys).params,
    }
    description = {"task": plain.plain(pools.ENV.spec), "settings": plain.plain(settings)}
    for method, n_demos in (("me-ddpg", 2), ("ddpg", 0)):
        for first in range(SEEDS):
            key = CellKey(0, "each", method, n_demos, first, 1)
            own = jax.tree.map(lambda leaf, first=first: leaf[first : first + 1], trees)
            own = own if n_demos else {"policies": own["policies"]}
            cells.save(tmp_path, key, description, cells_of.rows(key), own)
    return tmp_path


def test_a_card_has_every_measure_of_the_car_and_a_map(folder):
    run = reward_samples.read(folder)
    rows = reward_cards.of_run(run)
    assert rows.columns == ["method", "n_demos", "seed", *reward_cards.MEASURES]
    assert rows["seed"].to_list() == [0, 1]
    assert rows["method"].unique().to_list() == ["me-ddpg"]
    for name in ("epic_uniform", "dard_visited", "starc", "auc", "auc_held_out"):
        assert rows[name].is_between(0.0, 1.0).all()
    # 100 at the goal makes loitering pay from 1.01 a step on.
    np.testing.assert_allclose(rows["loitering"], rows["largest"] / 1.0101, rtol=1e-4)
    (agreement,) = reward_agreement.of_run(run)
    assert agreement.distance.shape == (2, 2)
    importances = reward_slices.importances(run)
    assert importances["seed"].to_list() == [0, 1]
    assert len(reward_slices.figure(run, importances)().axes) == 3
    maps = reward_maps.of_run(run)
    assert maps is not None
    assert len(maps().axes) >= 8


def test_the_summary_has_an_interval_for_each_measure_of_each_cell():
    rows = pl.DataFrame(
        {
            "method": ["gail"] * 3 + ["me-ddpg"] * 3,
            "n_demos": [5] * 6,
            "seed": [0, 1, 2] * 2,
            "auc": [0.5, 0.6, 0.7, 0.9, 0.8, 1.0],
            "starc": [None] * 3 + [0.2, 0.2, 0.2],
        }
    )
    seeds = rows.select("method", "n_demos", "seed", expert_id=pl.lit(None, pl.Int32))
    found = reward_cards.summarise(rows, seeds)
    assert found.select("method", "measure").rows() == [
        ("gail", "auc"),
        ("me-ddpg", "starc"),
        ("me-ddpg", "auc"),
    ]
    np.testing.assert_allclose(found["mean"], [0.6, 0.2, 0.9])
    assert (found["low"] <= found["mean"]).all()


def test_runs_without_rewards_or_demonstrations_are_refused(untrained_run, tmp_path):
    run = shutil.copytree(untrained_run, tmp_path / "run")
    with pytest.raises(UserError, match="no demonstrations to assess"):
        reward_samples.read(run)
    stored_demonstrations.save(run, pools.scripted(3))
    with pytest.raises(UserError, match="none of its methods learns a reward"):
        reward_samples.read(run)
