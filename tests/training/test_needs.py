"""State-only demonstrations are for what does not read actions, and are never read elsewhere."""

import jax
import numpy as np
import pytest

from cmedirl_jax import training
from cmedirl_jax.training import needs
from cmedirl_jax.training.methods import METHODS
from tests.support import pools
from tests.support.trainers import ENV, SMALL, with_

STATES = with_(reward_network={"inputs": "state"})


@pytest.fixture(scope="module")
def shown():
    """Demonstrations without actions and rewards."""
    pool = pools.scripted()
    made = pool.transition
    lacking = made._replace(
        action=np.full_like(made.action, np.nan), reward=np.full_like(made.reward, np.nan)
    )
    metadata = pool.metadata | {"absent": ["action", "reward"]}
    return pool._replace(transition=lacking, metadata=metadata)


@pytest.mark.parametrize(
    "method",
    ["irl-only", *(pytest.param(name, marks=pytest.mark.slow) for name in ("me-ddpg", "gail"))],
)
def test_a_reward_of_states_is_learned_from_states_alone(shown, method):
    fit = jax.jit(
        lambda key: training.fit(
            key, ENV, method, shown, seeds=2, steps=60, settings=STATES, evaluate_every=60
        )
    )
    result = fit(jax.random.key(0))
    state = result.states
    before = training.make(ENV, METHODS[method], STATES, capacity=60)
    for leaf in jax.tree.leaves((state.reward.params, state.agent.actor, state.agent.critic)):
        assert np.isfinite(leaf).all()
    assert result.episodes.reward_learned.any()
    assert np.isfinite(result.episodes.reward.demonstration_reward).all()
    assert before.algorithm.learner is not None


@pytest.mark.parametrize(
    ("method", "settings", "message"),
    [
        ("hs-me-ddpg", STATES, "hs-me-ddpg starts hot from demonstrated actions: the demonstr"),
        ("bc", STATES, "me-ddpg, irl-only and gail do without"),
        ("deep-maxent-irl", STATES, "deep-maxent-irl counts demonstrated actions"),
        ("me-ddpg", SMALL, "give reward_network.inputs state"),
        ("irl-only", with_(STATES, reward_batches={"weights": "fusion"}), "fits a density to demo"),
    ],
)
def test_what_reads_actions_refuses_them(shown, method, settings, message):
    with pytest.raises(ValueError, match=message):
        training.fit(jax.random.key(0), ENV, method, shown, seeds=1, steps=250, settings=settings)


def test_returns_are_read_by_two_losses_of_the_critic():
    needs.check(METHODS["hs-ddpg"], SMALL, ["reward"])
    needs.check(METHODS["ddpg"], SMALL, ["reward", "action"])
    for critic in needs.RETURNS:
        with pytest.raises(ValueError, match="hs-ddpg fits its critic to returns"):
            needs.check(METHODS["hs-ddpg"], with_(hot_start={"critic": critic}), ["reward"])
