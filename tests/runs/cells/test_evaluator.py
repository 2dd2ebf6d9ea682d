import jax
import numpy as np
import pytest

from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.cells import evaluator as evaluator_lib
from cmedirl_jax.training.evaluation import Rollouts
from tests.support import reference

ARCHITECTURE = Architecture(hidden=(4,))
SEEDS, GROUP, STARTS = 3, 2, 4
LIMIT = 30


@pytest.fixture(scope="module")
def nearby(env):
    """The mountain car, close enough to the goal that some random policies reach it."""
    params = env.default_params.replace(
        max_episode_steps=LIMIT, start_low=0.2, start_high=0.44, power=0.003
    )
    return env._replace(spec=env.spec._replace(max_episode_steps=LIMIT), default_params=params)


@pytest.fixture(scope="module")
def evaluator(nearby):
    return evaluator_lib.of_networks(nearby, ARCHITECTURE, GROUP, jax.devices()[:1])


@pytest.fixture(scope="module")
def actors():
    draw = np.random.default_rng(4).normal
    layers = {
        "Dense_0": {"kernel": draw(size=(SEEDS, 2, 4)), "bias": draw(size=(SEEDS, 4))},
        "Dense_1": {"kernel": draw(size=(SEEDS, 4, 1)), "bias": draw(size=(SEEDS, 1))},
    }
    return {"params": jax.tree.map(np.float32, layers)}


def episode(actor, position, params):
    """Return, length and whether the goal was reached, in double precision."""
    velocity, total, length, reached = 0.0, 0.0, 0, False
    while not reached and length < LIMIT:
        scaled = np.array([(position + 0.3) / 0.9, velocity / 0.07])
        action = np.tanh(reference.mlp(actor, scaled))[0]
        velocity += action * params.power - params.gravity * np.cos(3.0 * position)
        velocity = np.clip(velocity, -params.max_speed, params.max_speed)
        position += velocity
        if position < params.min_position:
            position, velocity = params.min_position, 0.0
        reached = position >= params.goal_position and velocity >= 0.0
        total += params.goal_reward * reached - params.action_cost * action**2
        length += 1
    return total, length, reached


def test_rollouts_from_the_fixed_starts_match_double_precision(evaluator, actors, nearby):
    params = nearby.default_params
    edges = np.linspace(params.start_low, params.start_high, STARTS + 1)
    positions = (edges[:-1] + edges[1:]) / 2
    expected = [
        [episode(reference.float64(actor), position, params) for position in positions]
        for actor in (jax.tree.map(lambda leaf, i=i: leaf[i], actors) for i in range(SEEDS))
    ]
    returns, lengths, reached = np.moveaxis(np.array(expected), -1, 0)
    assert 0 < reached.sum() < reached.size
    found = evaluator.on_starts(actors, STARTS)
    np.testing.assert_allclose(found.episode_return, returns, atol=1e-3)
    np.testing.assert_array_equal(found.length, lengths)
    np.testing.assert_array_equal(found.terminated, reached)


def test_fresh_starts_are_the_same_for_every_seed_and_follow_the_key(evaluator, actors):
    same = jax.tree.map(lambda leaf: leaf[:1].repeat(SEEDS, 0), actors)
    first, again, other = (
        np.asarray(evaluator.on_fresh_starts(same, jax.random.key(key), STARTS).episode_return)
        for key in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, first[:1].repeat(SEEDS, 0))
    np.testing.assert_array_equal(first, again)
    assert np.unique(first[0]).size == STARTS
    assert not np.intersect1d(first[0], other[0]).size


def test_summarise_reduces_over_the_starts(evaluator):
    found = evaluator.summarise(
        Rollouts(
            episode_return=np.array([[1.0, 3.0], [5.0, 5.0]], np.float32),
            length=np.array([[10, 20], [7, 8]], np.int32),
            terminated=np.array([[True, False], [True, True]]),
        )
    )
    np.testing.assert_array_equal(found.return_mean, [2.0, 5.0])
    np.testing.assert_array_equal(found.return_std, [1.0, 0.0])
    np.testing.assert_array_equal(found.length_mean, [15.0, 7.5])
    np.testing.assert_array_equal(found.goal_fraction, [0.5, 1.0])
