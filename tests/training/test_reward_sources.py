import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs, irl
from cmedirl_jax.irl import rewards
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import Method
from cmedirl_jax.training.reward_sources import REWARDS, RewardSettings, RewardSource
from cmedirl_jax.training.settings import Settings

SPEC = envs.make("MountainCarContinuous-v0").spec
OBSERVATION, ACTION = jnp.array([[-0.5, 0.01], [0.2, 0.0]]), jnp.array([[0.5], [-1.0]])


@pytest.mark.parametrize("name", REWARDS)
def test_every_source_makes_a_reward_of_pairs_within_its_bound(name):
    settings = RewardSettings()
    learner = REWARDS[name].make(SPEC, settings, rewards.make(SPEC))
    r_d = learner.reward(learner.init(jax.random.key(0)), OBSERVATION, ACTION)
    assert r_d.shape == (2,)
    assert np.all(np.abs(r_d) <= settings.reward.bound)


def test_only_learned_sources_sample():
    assert {name for name, source in REWARDS.items() if source.sampling} == {"maxent", "gail"}
    settings = RewardSettings()
    assert REWARDS["maxent"].sampling(settings).batches == settings.reward_batches


def test_an_unknown_source_lists_those_there_are():
    with pytest.raises(ValueError, match="unknown source of rewards 'mine'; there are: maxent"):
        compose.compose(SPEC, Method("mine", "", reward="mine"), Settings(), capacity=10)


def test_a_source_of_ones_own_is_an_entry(monkeypatch):
    mine = RewardSource(lambda spec, settings, network: irl.controls.constant(0.07))
    monkeypatch.setitem(REWARDS, "mine", mine)
    algorithm = compose.compose(SPEC, Method("mine", "", reward="mine"), Settings(), capacity=10)
    state = algorithm.learner.init(jax.random.key(0))
    np.testing.assert_allclose(algorithm.learner.reward(state, OBSERVATION, ACTION), 0.07)
    assert algorithm.sampler is None
