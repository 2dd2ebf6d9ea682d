import numpy as np
import polars as pl

from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.runs.report.reward_samples import Learners, with_experts
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.types import Transition
from tests.support import trainers


def steps(first):
    """Three steps of two seeds, numbered from `first`."""
    numbers = first + np.arange(6.0).reshape(2, 3)
    pairs = np.stack([numbers, -numbers], axis=-1)
    return Transition(pairs, pairs[..., :1], numbers, pairs, numbers > 0)


LEARNERS = Learners(
    *(METHODS["gail"], 5, trainers.SMALL, np.array([3, 7]), Rewards(None, None)),
    demonstrated=steps(0.0),
    played=steps(100.0),
    held_out=None,
)


def test_visited_steps_are_each_seeds_demonstrated_ones_and_then_its_played_ones():
    expected = [[0, 1, 2, 100, 101, 102], [3, 4, 5, 103, 104, 105]]
    np.testing.assert_array_equal(LEARNERS.visited.reward, expected)
    np.testing.assert_array_equal(LEARNERS.visited.observation[..., 1], -np.array(expected))


def test_a_table_has_a_row_for_each_learner():
    table = LEARNERS.table({"auc": np.float32([0.5, 0.75])})
    assert table.rows(named=True) == [
        {"method": "gail", "n_demos": 5, "seed": 3, "auc": 0.5},
        {"method": "gail", "n_demos": 5, "seed": 7, "auc": 0.75},
    ]


def test_rows_get_the_expert_of_their_learner_and_null_without_one():
    rows = pl.DataFrame(
        {"method": ["r_e", "gail", "gail"], "n_demos": [0, 5, 10], "seed": [3, 3, 3]}
    )
    seeds = pl.DataFrame(
        {"method": ["gail"] * 2, "n_demos": [10, 5], "seed": [3, 3], "expert_id": [1, 2]}
    )
    found = with_experts(rows, seeds).sort("n_demos")
    assert found["expert_id"].to_list() == [None, 2, 1]
