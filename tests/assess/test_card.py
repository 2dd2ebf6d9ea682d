"""Report cards of rewards whose relation to the true one is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.assess import card
from cmedirl_jax.assess import coverage as coverage_lib
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.tabular import discretise
from cmedirl_jax.tabular.optimal_control import value_iteration
from cmedirl_jax.types import Transition
from tests.support import pools

ENV, DISCOUNT = pools.ENV, 0.99
# The true reward, its negative, half of it and a constant, and one that has nothing to do with it.
WEIGHTS = np.array([[1, 0, 0], [-1, 0, 0], [0.5, 0, 3], [0, 1, 0]], np.float32)


def true(observation, action):
    """The car's own reward, by its definition."""
    position, speed = observation[..., 0], observation[..., 1]
    force = jnp.clip(action[..., 0], -1.0, 1.0)
    moved = jnp.clip(speed + 0.0015 * force - 0.0025 * jnp.cos(3 * position), -0.07, 0.07)
    there = jnp.clip(position + moved, -1.2, 0.6)
    moved = jnp.where((there <= -1.2) & (moved < 0), 0.0, moved)
    return 100.0 * ((there >= 0.45) & (moved >= 0.0)) - 0.1 * force**2


def mixture(weights, observation, action):
    noise = jnp.sin(1e4 * observation[..., 0]) + jnp.sin(1e4 * action[..., 0])
    return weights[0] * true(observation, action) + weights[1] * noise + weights[2]


REWARDS = Rewards(mixture, WEIGHTS)


def test_distances_to_the_true_reward_are_those_of_the_known_relations():
    keys = jax.random.split(jax.random.key(0), len(WEIGHTS))
    draw = jax.vmap(lambda key: coverage_lib.uniform(key, ENV, 256, 64))
    found = jax.device_get(jax.jit(lambda: card.truth(REWARDS, ENV, draw(keys), DISCOUNT))())
    for distance in (found.epic, found.dard):
        np.testing.assert_allclose(distance[:3], [0.0, 1.0, 0.0], atol=2e-2)
        assert 0.6 < distance[3] < 0.8
    np.testing.assert_allclose(found.correlation[:3], [1.0, -1.0, 1.0], atol=1e-3)
    assert abs(found.correlation[3]) < 0.3


def test_on_a_grid_the_optimums_advantage_correlates_with_itself():
    mdp = jax.jit(lambda: discretise.make(ENV, (21, 21), (5,)))()
    found = jax.device_get(jax.jit(lambda: card.on_grid(REWARDS, mdp, DISCOUNT))())
    np.testing.assert_allclose(found.starc[:2], [0.0, 1.0], atol=2e-2)
    # A constant of 3 a step makes never arriving the best that can be done.
    assert found.starc[2] > 0.9
    assert 0.6 < found.starc[3] < 0.8

    @jax.jit
    def card_of_the_advantage():
        best = value_iteration(mdp.dynamics, mdp.reward, discount=DISCOUNT, absorbing=mdp.absorbing)
        advantage = best.action_values - best.values[:, None]

        def looked_up(params, observation, action):
            del observation, action
            return params * advantage[:-1]

        return card.on_grid(Rewards(looked_up, np.float32([2.0, -1.0])), mdp, DISCOUNT)

    found = jax.device_get(card_of_the_advantage())
    np.testing.assert_allclose(found.advantage, [1.0, -1.0], atol=1e-3)
    # A policy is ranked by its advantages: they are equivalent to the reward.
    assert found.starc[0] < 0.1


def steps(actions):
    """Steps of one reward, whose observations do not matter."""
    count = len(actions)
    observation = np.zeros((1, count, 2), np.float32)
    rest = np.zeros((1, count), np.float32)
    action = np.asarray(actions, np.float32).reshape(1, count, 1)
    return Transition(observation, action, rest, observation, rest > 0)


def test_a_reward_that_pays_demonstrations_more_tells_them_apart():
    rewards = Rewards(lambda params, observation, action: params * action[..., 0], np.ones(1))
    shown, others = steps([1.0, 2.0, 3.0]), steps([0.0, 2.0, -1.0])
    found = jax.jit(lambda: card.told(rewards, shown, others))()
    assert found.auc[0] == pytest.approx((2 + 2.5 + 3) / 9)
    assert (found.largest[0], found.smallest[0]) == (3.0, -1.0)
    compare = jax.jit(lambda *pairs: card.occupancies(jax.random.key(0), np.ones(3), *pairs))
    apart, same = compare(shown, others), compare(shown, shown)
    assert apart.wasserstein[0] > 0.5
    assert same.wasserstein[0] == 0.0


def test_above_the_threshold_a_constant_pays_more_than_the_goal():
    threshold = card.loitering(0.99, 100.0)
    assert threshold == pytest.approx(1.0101, abs=1e-4)
    # A step that pays it forever is worth what the bonus is a step from now.
    assert threshold / (1 - 0.99) * 0.99 == pytest.approx(100.0)
