"""Vector environments in every autoreset mode, stepped as one."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from cmedirl_jax.envs import stepping
from tests.support.host_tasks import Counting


def vector_of(count, mode=AutoresetMode.DISABLED, **kwargs):
    return SyncVectorEnv([lambda: Counting(**kwargs)] * count, autoreset_mode=mode)


def test_what_knows_no_mask_is_refused():
    class Whole(SyncVectorEnv):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed)

    vector = Whole([Counting] * 2)
    before = stepping.reset(vector, np.array([0, 2]))
    assert np.array_equal(
        stepping.restart(vector, np.array([5, 6]), before[:, 0] < 0, before), before
    )
    with pytest.raises(ValueError, match="does not know the option reset_mask"):
        stepping.restart(vector, np.array([5, 6]), np.array([True, False]), before)


def test_observations_that_are_no_numbers_are_no_fault_of_the_others():
    before = np.array([[np.nan, 1.0], [2.0, 2.0]], np.float32)

    class Nan(SyncVectorEnv):
        def reset(self, *, seed=None, options=None):
            found, infos = super().reset(seed=seed, options=options)
            return np.concatenate([before[:1], found[1:]]), infos

    vector = Nan([Counting] * 2)
    stepping.reset(vector, np.array([0, 2]))
    found = stepping.restart(vector, np.array([5, 6]), np.array([False, True]), before)
    np.testing.assert_array_equal(found, [[np.nan, 1.0], [6.0, 0.0]])


def test_actions_are_finite_and_within_the_bounds():
    vector = vector_of(3)
    stepping.reset(vector, np.array([2, 2, 2]))
    answer = stepping.step(vector, np.array([[np.nan], [7.0], [-0.25]], np.float32))
    np.testing.assert_array_equal(answer.reward, np.float32([0.0, 1.0, -0.25]))
    assert answer.observation.dtype == answer.reward.dtype == np.float32
