import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.data import replay
from cmedirl_jax.training import updates
from cmedirl_jax.training.methods import METHODS
from tests.support.trainers import ENV, start, with_


def test_a_terminated_transition_earns_what_the_absorbing_state_goes_on_to():
    settings = with_(reward={"absorbing": True})
    trainer, state, _ = start("me-ddpg", settings)
    parts = updates.make_parts(trainer.algorithm, METHODS["me-ddpg"], settings)
    reward = state.reward.replace(params=state.reward.params._replace(absorbing=jnp.asarray(0.3)))
    batch = replay.unpack(ENV.spec, jnp.ones((2, 7)))._replace(terminated=jnp.array([False, True]))
    shaped = updates.with_shaped_reward(parts, reward, batch, 0.9, 0.5)
    r_d = trainer.algorithm.learner.reward(reward, batch.observation, batch.action)
    absorbing = 0.1 * np.tanh(0.3)
    expected = batch.reward + 0.5 * (r_d + np.array([0.0, 0.9 / (1 - 0.9) * absorbing]))
    np.testing.assert_allclose(shaped.reward, expected, rtol=1e-5)


def test_where_nothing_is_learned_from_demonstrations_nothing_is_drawn_for_it():
    trainer, state, _ = start("hs-me-ddpg")
    steps = jnp.arange(5)

    def draw(demonstrated):
        def of_step(step):
            return trainer.draw(state.key, state.subset, step, demonstrated).updates

        return jax.vmap(of_step)(steps)

    drawn, spared = draw(True), draw(jnp.array(False))
    np.testing.assert_array_equal(spared.batch, drawn.batch)
    for kept, zeros in zip(
        jax.tree.leaves((drawn.reward, drawn.cloning)),
        jax.tree.leaves((spared.reward, spared.cloning)),
        strict=True,
    ):
        assert zeros.shape == kept.shape
        assert kept.any()
        assert not zeros.any()
