"""Training on a task whose observations have no sensible bounds."""

import jax
import numpy as np
import pytest

from cmedirl_jax import networks, observation_statistics, training
from cmedirl_jax.observation_statistics import STATISTICS, Statistics
from cmedirl_jax.training.methods import METHODS
from tests.support import pools, trainers

UNBOUNDED = trainers.ENV._replace(
    spec=trainers.ENV.spec._replace(
        observation_low=np.array([-np.inf, -3.4e38], np.float32),
        observation_high=np.array([np.inf, 3.4e38], np.float32),
    )
)
STEPS = 60


def trained(method, steps=STEPS):
    """A seed before and after some steps."""
    settings = trainers.with_(agent={"tau": 0.5})
    trainer = training.make(UNBOUNDED, METHODS[method], settings, capacity=100)
    data = trainers.data() if METHODS[method].uses_demonstrations else None
    before = jax.jit(trainer.init, static_argnums=2)(jax.random.key(0), data, 3)
    after, _ = jax.jit(trainer.run)(before, data, np.arange(steps, dtype=np.int32))
    return trainer, before, after


def of_networks(state):
    agent = state.agent
    trees = [agent.actor, agent.critic, agent.target_actor, agent.target_critic]
    if state.reward is not None:
        trees.append(state.reward.params.network)
    return [tree[STATISTICS] for tree in trees]


def test_without_demonstrations_they_are_those_of_the_observations_so_far():
    _, before, after = trained("ddpg")
    assert all(set(np.asarray(kept["std"])) == {1.0} for kept in of_networks(before))
    replay = after.storage[:STEPS]
    # The first observation, what each step led to, and the start of the second episode.
    spec = UNBOUNDED.spec
    second = replay[trainers.LIMIT : trainers.LIMIT + 1, : spec.observation_dim]
    seen = np.concatenate([[before.observation], _next_observations(replay, spec), second])
    for kept in of_networks(after):
        np.testing.assert_allclose(kept["mean"], seen.mean(axis=0), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(kept["std"], seen.std(axis=0), rtol=1e-3)


def _next_observations(rows, spec):
    # A row is (observation, action, reward, next observation, terminated).
    first = spec.observation_dim + spec.action_dim + 1
    return rows[:, first : first + spec.observation_dim]


@pytest.mark.parametrize("method", ["me-ddpg", "hs-me-ddpg", "gail"])
def test_with_demonstrations_they_are_the_demonstrations_and_stay(method):
    _, before, after = trained(method)
    assert before.observation_statistics is None
    start, length = (np.asarray(leaf) for leaf in before.subset)
    rows = np.concatenate([np.arange(s, s + n) for s, n in zip(start, length, strict=True)])
    shown = np.asarray(trainers.data().transition.observation)[rows]
    trees = [before.agent.actor, after.agent.critic, after.agent.target_actor]
    trees.append(after.reward.params if method == "gail" else after.reward.params.network)
    for tree in trees:
        np.testing.assert_allclose(tree[STATISTICS]["mean"], shown.mean(axis=0), atol=0.02)
        np.testing.assert_allclose(tree[STATISTICS]["std"], shown.std(axis=0), rtol=0.06)


def test_evaluation_uses_the_policys_own_and_leaves_them():
    trainer, _, after = trained("ddpg")
    observation = np.array([[-0.3, 0.01], [-0.9, 0.02]], np.float32)
    kept = after.agent.actor[STATISTICS]
    found = trainer.act(after.agent.actor, observation)
    made = networks.make(UNBOUNDED.spec, trainers.SMALL.architecture)
    plain = observation_statistics.put(after.agent.actor, Statistics(np.zeros(2), np.ones(2)))
    scaled = (observation - kept["mean"]) / kept["std"]
    np.testing.assert_allclose(found, networks.policy(made, plain, scaled), rtol=1e-5)


def test_a_stopped_seed_keeps_its_statistics():
    settings = trainers.with_(agent={"tau": 0.5})
    trainer = training.make(UNBOUNDED, METHODS["ddpg"], settings, capacity=200)
    state = trainer.init(jax.random.key(0), None, 0)
    steps = np.arange(trainers.LIMIT, dtype=np.int32)
    state, _ = jax.jit(trainer.run)(state, None, steps, 1)
    later, _ = jax.jit(trainer.run)(state, None, steps + trainers.LIMIT, 1)
    assert int(later.episode) == 1
    np.testing.assert_array_equal(
        later.agent.actor[STATISTICS]["mean"], state.agent.actor[STATISTICS]["mean"]
    )


def test_the_bounded_task_needs_none():
    trainer = training.make(pools.ENV, METHODS["ddpg"], trainers.SMALL, capacity=100)
    state = trainer.init(jax.random.key(0), None, 0)
    assert state.observation_statistics is None
    assert not observation_statistics.kept((state.agent.actor, state.agent.critic))


def test_statistics_are_of_32_bits_under_x64_too():
    with jax.enable_x64(True):
        params = networks.make(UNBOUNDED.spec).actor.init(jax.random.key(0))
    assert {leaf.dtype for leaf in params[STATISTICS].values()} == {np.dtype(np.float32)}
