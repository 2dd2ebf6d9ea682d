import numpy as np

from cmedirl_jax.commands import demonstrators
from tests.support import pools


def pool(**metadata):
    """Episodes of 2 and 4 steps that return 10 and 40; the first one terminated."""
    made = pools.random_pool([2, 4])
    transition = made.transition._replace(reward=np.float32([5, 5, 10, 10, 10, 10]))
    known = {"source": "somebody", "seeds": [7, 8]}
    return made._replace(transition=transition, metadata=known | metadata)


def test_a_datasheet_counts_episodes_steps_and_returns():
    said = demonstrators.datasheet(pool(), pools.ENV.spec)
    for part in (
        "2 episodes, 6 steps; 2 to 4 steps an episode; the task ended 1, the time limit the others",
        "returns 25 ± 15, from 10 to 40",
        "2 observations, 1 actions",
        "who acted: somebody",
        "reset seeds 7 to 8",
    ):
        assert part in said
    assert "scores" not in said


def test_a_datasheet_scores_between_random_actions_and_the_expert():
    said = demonstrators.datasheet(pool(ref_min_score=-25.0, ref_max_score=175.0), pools.ENV.spec)
    assert "random actions return -25, the expert 175" in said
    assert "this dataset scores 0.25\n" in said
