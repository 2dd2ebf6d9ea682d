"""Whether the seeds of a method agree."""

import numpy as np
import pytest

from cmedirl_jax.runs.report import reward_agreement
from cmedirl_jax.runs.report.reward_agreement import Agreement
from cmedirl_jax.runs.report.reward_samples import Learners
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings


def learners(seeds, method="gail"):
    """Learners whose rewards and steps do not matter."""
    return Learners(METHODS[method], 5, Settings(), np.array(seeds), *[None] * 4)


def test_disagreement_is_the_mean_distance_to_the_others():
    # The last reward is a constant, which is unrelated even to itself.
    distance = np.array([[0.0, 0.2, 0.7], [0.2, 0.0, 0.7], [0.7, 0.7, 0.7]])
    found = [Agreement(learners([4, 5, 9]), distance)]
    rows = reward_agreement.rows(found)
    assert rows["seed"].to_list() == [4, 5, 9]
    assert rows["disagreement"].to_list() == pytest.approx([0.45, 0.45, 0.7])
    assert len(reward_agreement.figure(found).axes) == 2
    alone = reward_agreement.rows([Agreement(learners([0]), np.zeros((1, 1)))])
    assert alone["disagreement"].to_list() == [None]
