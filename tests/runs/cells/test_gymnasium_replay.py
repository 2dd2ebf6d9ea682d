import types

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import networks
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.cells import evaluator as evaluator_lib
from cmedirl_jax.runs.cells import gymnasium_replay

ARCHITECTURE = Architecture(hidden=(2,), output_scale=1.0)


def test_policies_return_in_gymnasium_what_they_return_in_jax(env, spec):
    actor = networks.make(spec, ARCHITECTURE).actor.init(jax.random.key(1))
    # tanh(5 v / v_max) pushes in the direction of motion and reaches the goal.
    layers = {
        "Dense_0": {"kernel": np.array([[0.0, 0.0], [1.0, -1.0]]), "bias": np.zeros(2)},
        "Dense_1": {"kernel": np.array([[5.0], [-5.0]]), "bias": np.array([0.01])},
    }
    actors = jax.tree.map(lambda *leaves: np.stack(leaves), actor, {"params": layers})
    evaluator = evaluator_lib.of_networks(env, ARCHITECTURE, 2, jax.devices()[:1])

    found = gymnasium_replay.replay(evaluator, actors, env)

    assert found.gymnasium_return.shape == (2, gymnasium_replay.STARTS)
    np.testing.assert_allclose(found.gymnasium_return, found.jax_return, atol=1e-3)
    assert (found.gymnasium_return[0] < 0.0).all()
    assert (found.gymnasium_return[1] > 90.0).all()


def test_episodes_are_cut_at_the_specifications_limit(env):
    short = env._replace(spec=env.spec._replace(max_episode_steps=7))
    evaluator = types.SimpleNamespace(
        act=lambda actor, observations: jnp.broadcast_to(actor, (*observations.shape[:-1], 1)),
        on_starts=lambda actors, count: types.SimpleNamespace(episode_return=None),
        gather=lambda arrays: arrays,
    )
    found = gymnasium_replay.replay(evaluator, np.array([0.0, -1.0], np.float32), short)
    expected = [[0.0] * gymnasium_replay.STARTS, [-0.7] * gymnasium_replay.STARTS]
    np.testing.assert_allclose(found.gymnasium_return, expected, rtol=1e-6)
