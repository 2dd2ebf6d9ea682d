import pytest

from cmedirl_jax import envs


def test_an_unknown_environment_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'Pendulum-v0'.*MountainCarContinuous-v0"):
        envs.make("Pendulum-v0")
