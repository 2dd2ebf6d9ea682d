import types

import jax
import numpy as np
import pytest

from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs.cells import evaluator, experts
from cmedirl_jax.runs.cells.cell import CellResult
from cmedirl_jax.runs.cells.record import EvaluationRows
from cmedirl_jax.runs.config import Experts
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.training import evaluation
from cmedirl_jax.training.evaluation import Evaluation
from tests.support.scripted import STRENGTHS, act


@pytest.mark.parametrize(
    ("which", "chosen"),
    [("best", [3]), ("median", [1]), ("all", [1, 3, 4]), ("each", [1, 3, 4])],
)
def test_choose_ranks_only_the_experts_that_solved_the_task(which, chosen):
    returns = np.array([89.0, 91.0, 10.0, 94.0, 90.0])
    np.testing.assert_array_equal(experts.choose(returns, which, 90.0), chosen)


def test_the_median_of_two_experts_is_the_lower():
    np.testing.assert_array_equal(experts.choose(np.array([94.0, 91.0]), "median", 90.0), [1])


@pytest.mark.parametrize("which", ["best", "median", "all", "each"])
def test_choose_takes_nobody_if_none_solved_the_task(which):
    assert experts.choose(np.array([89.0, 10.0]), which, 90.0).size == 0


@pytest.fixture
def make_pool(env, monkeypatch):
    """`make_pool` with the scripted policies in the place of trained experts.

    Takes the seeds that were evaluated at the end, and their returns.
    """

    def make(seeds, returns, trajectories=3, which="all"):
        def train(*args, seeds_count, **kwargs):
            zeros = np.zeros(len(seeds))
            found = Evaluation(np.array(returns), zeros, zeros, zeros)
            first = EvaluationRows("steps", np.arange(2), *[None] * 4)
            last = EvaluationRows("steps", np.array(seeds), zeros, zeros, found, None)
            return CellResult(
                evaluations=[first, last],
                episodes=None,
                best=None,
                reward=None,
                env_steps=np.full(seeds_count, 500),
                demonstration_steps=None,
                diverged=~np.isin(np.arange(seeds_count), seeds),
                final=STRENGTHS,
            )

        monkeypatch.setattr(experts.cell_lib, "train", train)
        return experts.make_pool(
            jax.random.key(0),
            env,
            Experts(which, seeds=STRENGTHS.size, steps=500, trajectories=trajectories),
            types.SimpleNamespace(evaluator=evaluator.make(env, act, 1, jax.devices()[:1])),
            10,
            lambda progress: None,
        )

    return make


def test_the_pool_is_made_by_the_experts_that_solved_the_task(make_pool, spec, tmp_path):
    pool = make_pool([0, 1], [97.0, 0.0])
    demonstrations.save(tmp_path / "pool.npz", pool)
    metadata = demonstrations.load(tmp_path / "pool.npz", spec).metadata
    assert metadata["experts_demonstrating"] == [0]
    assert metadata["experts_solved"] == 1
    assert metadata["experts_trained"] == 2
    assert metadata["expert_env_steps"] == 1_000
    assert (demonstrations.returns(pool) > 90.0).all()
    assert demonstrations.returns(pool).size == 3


def test_several_experts_share_the_trajectories_and_make_no_fewer_than_asked(make_pool):
    pool = make_pool([0, 1], [97.0, 95.0], trajectories=3)
    np.testing.assert_array_equal(demonstrations.returns(pool) > 90.0, [True, True, False, False])


def test_each_expert_makes_all_the_trajectories_of_its_learner(make_pool, env):
    pool = make_pool([0, 1], [97.0, 95.0], trajectories=3, which="each")
    solved = demonstrations.returns(pool) > 90.0
    np.testing.assert_array_equal(solved, [True, True, True, False, False, False])
    assert pool.metadata["expert"] == "each"


def test_experts_are_evaluated_on_the_learners_starts(make_pool, env):
    starts = env.starts(10, env.default_params)
    found = make_pool([0, 1], [97.0, 95.0]).metadata["expert_returns"]
    expected = [
        evaluation.rollout(
            lambda seen, i=i: act(STRENGTHS[i], seen), env, env.default_params, starts
        )
        for i in range(2)
    ]
    np.testing.assert_allclose(found, [np.mean(one.episode_return) for one in expected], rtol=1e-5)


def test_an_experts_episodes_do_not_depend_on_who_else_demonstrates(make_pool):
    both = make_pool([0, 1], [97.0, 95.0], which="each")
    alone = make_pool([1], [97.0], which="each")
    later = both.episode >= 3
    np.testing.assert_array_equal(both.transition.observation[later], alone.transition.observation)


def test_no_expert_that_solved_the_task_is_a_users_error(make_pool):
    with pytest.raises(UserError, match=r"^--experts: none of 2 experts .*--experts\.steps"):
        make_pool([0, 1], [89.0, 0.0])


def test_a_diverged_expert_does_not_shift_the_others(make_pool):
    pool = make_pool([1], [97.0])
    assert pool.metadata["experts_demonstrating"] == [1]
