import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from cmedirl_jax.runs.cells.cell import CellResult
from cmedirl_jax.runs.cells.gymnasium_replay import ReplayedReturns
from cmedirl_jax.runs.cells.pools import LearnersPool
from cmedirl_jax.runs.cells.record import EpisodeRows, EvaluationRows, Means
from cmedirl_jax.runs.storage import tables
from cmedirl_jax.runs.storage.cells import CellKey
from cmedirl_jax.training.evaluation import Evaluation

LABELS = {"study": pl.Int64, "expert": pl.String, "method": pl.String, "n_demos": pl.Int32}
MEANS = [
    *("q_mean", "critic_loss", "r_d_mean"),
    *("demonstration_reward", "background_reward", "effective_sample_size", "r_d_std"),
]
SCHEMAS = {
    "evaluations": {
        "protocol": pl.String,
        **dict.fromkeys(("seed", "env_step", "episode"), pl.Int32),
        **dict.fromkeys(("return_mean", "return_std", "goal_fraction", "length_mean"), pl.Float32),
        **dict.fromkeys(MEANS, pl.Float64),
    },
    "episodes": {
        **dict.fromkeys(("seed", "episode", "env_step"), pl.Int32),
        "return": pl.Float32,
        "length": pl.Int32,
        "terminated": pl.Boolean,
    },
    "seeds": {
        **dict.fromkeys(("seed", "expert_id"), pl.Int32),
        "expert_return": pl.Float64,
        **dict.fromkeys(("env_steps", "episodes", "demonstration_steps"), pl.Int32),
        "expert_steps": pl.Int64,
        "diverged": pl.Boolean,
        **dict.fromkeys(("best_evaluation", "best_return"), pl.Float32),
        **dict.fromkeys(("gymnasium_return", "gymnasium_difference"), pl.Float64),
    },
}


def evaluation(protocol, env_step, *seeds):
    def floats(offset):
        return np.array(seeds, np.float32) + np.float32(offset)

    unknown = np.full(len(seeds), np.nan) if env_step == 0 else np.float64(floats(0.5))
    return EvaluationRows(
        protocol,
        np.array(seeds),
        np.full(len(seeds), env_step),
        np.full(len(seeds), env_step // 100),
        Evaluation(floats(env_step), floats(1), floats(2), floats(3)),
        Means(*(unknown for _ in Means._fields)),
    )


def experts(first_seed=0):
    """A pool in which learners 0 and 1 from `first_seed` on have expert 1, and 2 has several."""
    ids = np.r_[np.full(first_seed, 9), 1, 1, -1]
    none = np.full(first_seed, np.nan)
    steps = np.full(first_seed + 3, 4_000)
    return LearnersPool(None, ids, np.r_[none, 94.0, 94.0, np.nan], steps, {})


def rows(episodes, first_seed=0, experts=experts):
    pool = experts(first_seed)
    result = CellResult(
        evaluations=[
            evaluation("steps", 0, 0, 1, 2),
            evaluation("episodes", 250, 2, 0),
            evaluation("steps", 250, 2, 0),
        ],
        episodes=episodes,
        best=None,
        reward=None,
        env_steps=np.array([250, 100, 250]),
        demonstration_steps=np.array([70, 80, 90]),
        diverged=np.array([False, True, False]),
        final=None,
    )
    return tables.rows(
        result,
        CellKey(7, "best", "hs-ddpg", 10, first_seed, 3),
        best_return=np.array([93.0, 94.0, 95.0]),
        replay=ReplayedReturns(
            np.array([[1.0, 2.0, 3.0]] * 3), np.array([[1, 2, 3], [1, 2.5, 2.75], [0, 2, 3]])
        ),
        pool=pool,
    )


EPISODES = EpisodeRows(
    seed=np.array([2, 0, 0]),
    episode=np.array([1, 1, 2]),
    env_step=np.array([90, 80, 160]),
    episode_return=np.array([91.0, 92.0, -3.0]),
    length=np.array([90, 80, 80]),
    terminated=np.array([True, True, False]),
)


@pytest.fixture(scope="module")
def found():
    return rows(EPISODES)


@pytest.mark.parametrize("name", SCHEMAS)
def test_a_later_block_has_the_same_rows_of_later_seeds(found, name):
    later = rows(EPISODES, first_seed=100)[name]
    assert_frame_equal(later.with_columns(pl.col("seed") - 100), found[name])
    assert later["seed"].min() >= 100


@pytest.mark.parametrize("name", SCHEMAS)
def test_tables_have_the_designed_columns(found, name):
    assert found[name].schema == pl.Schema(LABELS | SCHEMAS[name])


@pytest.mark.parametrize("name", SCHEMAS)
def test_a_cell_without_episodes_has_the_same_columns(found, name):
    nothing = EpisodeRows(*(np.zeros(0, np.int32) for _ in EpisodeRows._fields))
    assert rows(nothing)[name].schema == found[name].schema


@pytest.mark.parametrize("name", SCHEMAS)
def test_every_row_names_its_cell(found, name):
    labels = found[name].select(*LABELS).unique()
    assert labels.rows() == [(7, "best", "hs-ddpg", 10)]


def test_evaluations_are_in_order_of_seed_and_step(found):
    table = found["evaluations"]
    assert table.select("protocol", "seed", "env_step", "return_mean").rows() == [
        ("steps", 0, 0, 0.0),
        ("episodes", 0, 250, 250.0),
        ("steps", 0, 250, 250.0),
        ("steps", 1, 0, 1.0),
        ("steps", 2, 0, 2.0),
        ("episodes", 2, 250, 252.0),
        ("steps", 2, 250, 252.0),
    ]


def test_statistics_of_no_update_are_missing_rather_than_nan(found):
    for env_step, *statistics in found["evaluations"].select("env_step", *MEANS).iter_rows():
        missing = [value is None for value in statistics]
        assert missing == [env_step == 0] * len(MEANS)


def test_episodes_are_in_order_of_seed_and_number(found):
    assert found["episodes"].select(*SCHEMAS["episodes"]).rows() == [
        (0, 1, 80, 92.0, 80, True),
        (0, 2, 160, -3.0, 80, False),
        (2, 1, 90, 91.0, 90, True),
    ]


def test_seeds_have_their_budget_episodes_and_replay(found):
    assert found["seeds"].select(*SCHEMAS["seeds"]).rows() == [
        (0, 1, 94.0, 250, 2, 70, 4_000, False, 250.0, 93.0, 2.0, 0.0),
        (1, 1, 94.0, 100, 0, 80, 4_000, True, 1.0, 94.0, 2.0, 0.5),
        (2, None, None, 250, 1, 90, 4_000, False, 252.0, 95.0, 2.0, 1.0),
    ]


def test_a_method_without_demonstrations_has_no_expert():
    seeds = rows(EPISODES, experts=lambda first_seed: None)["seeds"]
    assert (
        seeds.select("expert_id", "expert_return", "expert_steps").rows() == [(None, None, 0)] * 3
    )


def test_the_deviation_of_a_reward_is_that_of_its_values():
    values = np.random.default_rng(0).normal(0.1, 0.03, 50)
    filled = Means(*(np.zeros(1) for _ in Means._fields))._replace(
        r_d_mean=values.mean(keepdims=True), r_d_mean_square=(values**2).mean(keepdims=True)
    )
    assert tables.means(filled)["r_d_std"] == pytest.approx(values.std(), rel=1e-9)
