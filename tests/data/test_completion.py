"""What a task computes of demonstrations that lack something; test_reading has every format."""

import numpy as np

from cmedirl_jax.data import demonstrations
from tests.support import pools

SPEC = pools.ENV.spec


def test_nothing_is_computed_for_tasks_that_cannot_be_set_to_an_observation():
    short = {"observations": [[0, 0], [1, 0]], "actions": [[0.5], [0.25]], "terminated": True}
    pool = demonstrations.from_trajectories([short], SPEC.id)
    elsewhere = pools.ENV._replace(state_at=None)
    assert demonstrations.complete(pool, elsewhere) is pool
    whole = demonstrations.complete(pool, pools.ENV)
    assert np.isfinite(whole.transition.reward).all()
    assert whole.metadata["computed"] == ["next_observation", "reward"]
    assert demonstrations.complete(whole, pools.ENV) is whole
