import chex
import jax
import pytest

from tests.support.trainers import compiled, start


def test_behaviour_cloning_is_the_hot_start_alone():
    _, state, advance = start("bc")
    _, hot, _ = start("hs-ddpg")
    chex.assert_trees_all_equal(state.agent.actor, hot.agent.actor)
    with pytest.raises(ValueError, match="bc does not act"):
        advance(state, 0, 5)


def test_methods_with_demonstrations_ask_for_them():
    trainer, _, _ = compiled("hs-ddpg")
    with pytest.raises(ValueError, match="hs-ddpg needs demonstrations"):
        trainer.init(jax.random.key(0), None, 3)
