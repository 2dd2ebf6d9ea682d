import numpy as np
import pytest

from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs.cells import pools as pools_lib
from tests.support import pools

EACH = {
    "expert": "each",
    "experts_trained": 4,
    "experts_demonstrating": [0, 2],
    "expert_returns": [94.0, 95.0],
    "expert_env_steps": 4_000,
}


def of_learners(learners, **metadata):
    pool = pools.random_pool([3, 1, 4, 2, 2, 5])
    return pool, pools_lib.of_learners(pool._replace(metadata=metadata), learners)


def test_with_an_expert_each_a_learner_draws_from_its_own():
    pool, shared = of_learners(4, **EACH)
    # Experts 1 and 3 failed: the next that solved the task stands in, after the last the first.
    np.testing.assert_array_equal(shared.expert, [0, 2, 2, 0])
    np.testing.assert_array_equal(shared.expert_return, [94.0, 95.0, 95.0, 94.0])
    start, length = demonstrations.episodes(pool)
    for learner, block in enumerate([slice(0, 3), slice(3, 6), slice(3, 6), slice(0, 3)]):
        np.testing.assert_array_equal(shared.data.episodes.start[learner], start[block])
        np.testing.assert_array_equal(shared.data.episodes.length[learner], length[block])


def test_more_learners_than_experts_begin_again_with_the_first():
    np.testing.assert_array_equal(of_learners(7, **EACH)[1].expert, [0, 2, 2, 0, 0, 2, 2])


def test_an_expert_that_solves_the_task_costs_the_failed_ones_too():
    np.testing.assert_array_equal(of_learners(2, **EACH)[1].expert_steps, [2_000, 2_000])


@pytest.mark.parametrize(
    ("metadata", "expert", "score"),
    [
        ({}, -1, np.nan),
        ({"expert": "best", "experts_demonstrating": [7], "expert_returns": [94.5]}, 7, 94.5),
        ({"expert": "all", "experts_demonstrating": [1, 2], "expert_returns": [94, 96]}, -1, 95.0),
    ],
)
def test_otherwise_all_learners_draw_from_the_whole_pool(metadata, expert, score):
    pool, shared = of_learners(3, **metadata)
    np.testing.assert_array_equal(shared.expert, [expert] * 3)
    np.testing.assert_array_equal(shared.expert_return, [score] * 3)
    for field, of_pool in zip(shared.data.episodes, demonstrations.episodes(pool), strict=True):
        np.testing.assert_array_equal(field, np.tile(of_pool, (3, 1)))


@pytest.mark.parametrize("metadata", [EACH, {}, {"experts_demonstrating": [7]}])
def test_as_many_episodes_are_held_for_a_learner_as_it_draws_from(metadata):
    pool, shared = of_learners(4, **metadata)
    assert pools_lib.held(pool._replace(metadata=metadata)) == shared.data.episodes.start.shape[1]


@pytest.mark.parametrize(
    ("learners", "metadata", "message"),
    [
        (2, EACH | {"experts_trained": 2}, "do not say whose its episodes are"),
        (2, EACH | {"experts_trained": None}, "do not say whose its episodes are"),
        (2, EACH | {"experts_demonstrating": [0, 1, 2, 3]}, "do not say whose its episodes are"),
        (2, EACH | {"experts_demonstrating": []}, "do not say whose its episodes are"),
        (2, EACH | {"expert_returns": [94.0]}, "do not say whose its episodes are"),
        (2, EACH | {"experts_demonstrating": [0, "a"]}, "no list of whole numbers"),
        (2, {"experts_demonstrating": "all"}, "no list of whole numbers"),
    ],
)
def test_metadata_that_do_not_fit_are_refused(learners, metadata, message):
    with pytest.raises(ValueError, match=message):
        of_learners(learners, **metadata)
