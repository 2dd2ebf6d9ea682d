import numpy as np
import pytest

from cmedirl_jax import envs
from cmedirl_jax.envs import HostEnv
from cmedirl_jax.runs.report import reward_maps

CAR = envs.make("MountainCarContinuous-v0")
UNBOUNDED = np.full(2, np.inf, np.float32)


@pytest.mark.parametrize(
    ("env", "fits"),
    [
        (CAR, True),
        (CAR._replace(state_at=None), False),
        (CAR._replace(spec=CAR.spec._replace(observation_high=UNBOUNDED)), False),
        (HostEnv(CAR.spec, None), False),
        # Three observations; four, and two actions.
        (envs.make("Pendulum-v1"), False),
        (envs.make("PointMass-v0"), False),
    ],
)
def test_a_task_of_two_bounded_observations_and_one_action_can_be_drawn(env, fits):
    assert reward_maps.fits(env) is fits
