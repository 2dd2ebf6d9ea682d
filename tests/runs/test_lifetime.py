import pytest

from cmedirl_jax.runs.lifetime import Lifetime, lifetime


@pytest.mark.parametrize(
    ("episodes", "steps", "expected"),
    [
        (None, 12_000, Lifetime(12_000, None, False)),
        # An episode of the car has at most 999 steps.
        (8, None, Lifetime(7_992, 8, False)),
        (8, 7_992, Lifetime(7_992, 8, False)),
        # Eight long episodes do not fit into these steps; eight short ones do.
        (8, 7_991, Lifetime(7_991, None, True)),
    ],
)
def test_a_seed_ends_by_the_limit_that_binds(episodes, steps, expected):
    config = {"max_episodes": episodes, "max_steps": steps, "env": "MountainCarContinuous-v0"}
    assert lifetime(config) == expected
