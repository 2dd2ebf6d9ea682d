import jax
import jax.numpy as jnp
import pytest

from cmedirl_jax.types import EnvSpec, Network, RewardBatch, Transition

FIXED = {
    EnvSpec: (
        *("id", "observation_dim", "action_dim", "observation_low", "observation_high"),
        *("action_low", "action_high", "max_episode_steps", "reward_threshold"),
    ),
    Transition: ("observation", "action", "reward", "next_observation", "terminated"),
    RewardBatch: ("transition", "log_density", "mask"),
    Network: ("init", "apply", "train"),
}
"""Names and their order, which users rely on."""


@pytest.mark.parametrize("kind", FIXED)
def test_fields_keep_their_names_and_order(kind):
    assert kind._fields == FIXED[kind]


def test_only_a_network_with_running_statistics_has_a_third_function():
    assert Network(init=jnp.zeros, apply=jnp.add).train is None


def test_a_reward_batch_is_a_pytree():
    transition = Transition(jnp.ones((3, 2)), *(jnp.ones((3, 1)) for _ in range(4)))
    batch = RewardBatch(transition, jnp.zeros(3), jnp.ones(3, bool))
    first = jax.vmap(lambda batch: batch)(batch)
    assert jax.tree.structure(first) == jax.tree.structure(batch)
    assert len(jax.tree.leaves(batch)) == 7
