import pytest

from cmedirl_jax import envs
from cmedirl_jax.envs.registry import ENVS


def test_an_unknown_environment_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'Pendulum-v0'.*MountainCarContinuous-v0"):
        envs.make("Pendulum-v0")


def test_a_registered_environment_is_made_by_its_name(env, monkeypatch):
    monkeypatch.setattr(envs.registry, "ENVS", ENVS.copy())
    own = env._replace(spec=env.spec._replace(id="Own-v0"))
    envs.register("Own-v0", lambda: own)
    assert envs.make("Own-v0") is own


def test_a_name_is_registered_only_once(env):
    with pytest.raises(ValueError, match="'MountainCarContinuous-v0' is already registered"):
        envs.register("MountainCarContinuous-v0", lambda: env)


def test_an_environment_by_another_name_than_its_own_is_refused(env, monkeypatch):
    monkeypatch.setattr(envs.registry, "ENVS", ENVS.copy())
    envs.register("Own-v0", lambda: env)
    with pytest.raises(ValueError, match=r"'Own-v0': the id .* is 'MountainCarContinuous-v0'"):
        envs.make("Own-v0")
