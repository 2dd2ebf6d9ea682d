import functools
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from cmedirl_jax import networks
from cmedirl_jax.agents import ddpg, hot_start
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.data import demonstrations
from cmedirl_jax.networks import Architecture
from cmedirl_jax.training import evaluation
from cmedirl_jax.types import Network
from tests.support import pools, reference
from tests.support.agents import ARCHITECTURE, SMALL, SPEC, random_batch, reference_q, scaled

KINDS = ["softmax", "one-hot", "quadratic", "monte-carlo", "large-margin"]
# Smaller than the small network's differences of values, so that one step has no loss.
MARGIN = 0.02


def of_actions(dims):
    """The small networks of the car, had it actions of `dims` dimensions."""
    spec = SPEC._replace(
        action_dim=dims,
        action_low=np.full(dims, -1.0, np.float32),
        action_high=np.full(dims, 1.0, np.float32),
    )
    return networks.make(spec, ARCHITECTURE)


@functools.cache
def drawn():
    """The small networks' parameters."""
    return jax.jit(lambda key: (SMALL.actor.init(key), SMALL.critic.init(key)))(jax.random.key(0))


def reference_critic_loss(kind, critic, batch, returns, cells=5):
    grid = np.linspace(-1.0, 1.0, cells)
    losses = []
    for observation, action, g in zip(
        np.asarray(batch.observation), np.asarray(batch.action), returns, strict=True
    ):
        if kind == "monte-carlo":
            losses.append((reference_q(critic, observation[None], action[None])[0] - g) ** 2)
            continue
        for dimension, demonstrated in enumerate(action):
            nearest = np.argmin(abs(grid - demonstrated))
            values = grid.copy()
            if kind in ("one-hot", "large-margin"):
                values[nearest] = demonstrated
            actions = np.tile(action, (cells, 1))
            actions[:, dimension] = values
            q = reference_q(critic, np.tile(observation, (cells, 1)), actions)
            if kind == "large-margin":
                margin = MARGIN * (np.arange(cells) != nearest)
                losses.append(max(q + margin) - q[nearest])
                continue
            target = np.eye(cells)[nearest]
            if kind == "softmax":
                q = scipy.special.softmax(q)
            if kind == "quadratic":
                target = g - 20.0 * (values - demonstrated) ** 2
            losses.append(np.sum((q - target) ** 2))
    return np.mean(losses)


@pytest.mark.parametrize("dims", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_critic_loss_and_gradient_equal_a_float64_reference(kind, dims):
    hparams = HotStartHParams(critic=kind, cells=5, margin=MARGIN)
    small = of_actions(dims)
    batch, returns = random_batch(jax.random.key(0), 6, small.spec), np.linspace(-10.0, 90.0, 6)
    critic = jax.tree.map(
        lambda leaf: np.random.default_rng(leaf.size).uniform(-0.5, 0.5, leaf.shape),
        jax.eval_shape(small.critic.init, jax.random.key(1)),
    )
    critic = jax.tree.map(np.float32, critic)

    def loss(critic):
        return hot_start.critic_loss(
            small, critic, hparams, batch.observation, batch.action, jnp.asarray(returns)
        )[0]

    value, gradient = jax.jit(jax.value_and_grad(loss))(critic)

    def expected(critic):
        return reference_critic_loss(kind, critic, batch, returns)

    np.testing.assert_allclose(value, expected(reference.float64(critic)), rtol=1e-4)
    chex.assert_trees_all_close(
        gradient, reference.gradient(expected, critic), rtol=5e-3, atol=1e-3 * float(value) ** 0.5
    )


def test_softmaxes_along_the_dimensions_are_the_marginals_of_a_full_grid():
    made = of_actions(2)
    weights = np.float32([[1.5, -0.7], [-2.0, 0.4]])

    def value(weights, observation, action):
        q = (weights[0] * action + weights[1] * action**2).sum(axis=-1)
        return q + observation[..., 0]

    made = made._replace(critic=Network(lambda key: weights, value))
    hparams = HotStartHParams(critic="softmax")
    demonstrated = np.float32([[0.2, -1.0]])
    loss, _ = jax.jit(functools.partial(hot_start.critic_loss, made))(
        weights, hparams, np.zeros((1, 2)), demonstrated, np.zeros(1)
    )
    # The loss of the marginals of the softmax over all 11 x 11 actions.
    axis = np.linspace(-1.0, 1.0, 11)
    actions = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    full = scipy.special.softmax(value(weights, np.zeros(1), actions))
    marginals = full.sum(axis=1), full.sum(axis=0)
    cells = np.eye(11)[6], np.eye(11)[0]
    expected = [np.sum((p - cell) ** 2) for p, cell in zip(marginals, cells, strict=True)]
    np.testing.assert_allclose(loss, np.mean(expected), rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_the_actions_of_a_pair_grow_with_the_dimensions_and_not_as_a_power(kind):
    evaluated = []

    def value(params, observation, action):
        evaluated.append(math.prod(action.shape[:-1]))
        return params * jnp.sum(action, axis=-1)

    for dims in range(1, 9):
        made = of_actions(dims)
        made = made._replace(critic=Network(lambda key: jnp.zeros(()), value))
        batch = random_batch(jax.random.key(0), 32, made.spec)
        jax.eval_shape(
            lambda critic, made=made, batch=batch: hot_start.critic_loss(
                made,
                critic,
                HotStartHParams(critic=kind),
                batch.observation,
                batch.action,
                batch.reward,
            ),
            jnp.zeros(()),
        )
    of_a_pair = [1] * 8 if kind == "monte-carlo" else [11 * dims for dims in range(1, 9)]
    assert evaluated == [32 * actions for actions in of_a_pair]


def test_at_eight_dimensions_the_fitted_critic_prefers_the_demonstrated_action():
    made = of_actions(8)
    made = made._replace(critic=networks.critic(made.spec, Architecture(hidden=(16,))))
    pool = random_batch(jax.random.key(0), 200, made.spec)
    rng = np.random.default_rng(5)
    demonstrated = np.float32(np.tanh(scaled(pool.observation) @ rng.normal(size=(2, 8))))
    data = hot_start.HotStartData(
        pool._replace(action=demonstrated),
        np.zeros(200, np.float32),
        demonstrations.DemonstrationSubset(np.array([0]), np.array([200])),
    )
    hparams = HotStartHParams(steps=300, learning_rate=5e-3)

    @jax.jit
    def fit(key):
        params = made.actor.init(key), made.critic.init(key)
        return hot_start.fit(key, made, params, data, hparams)[1]

    value = jax.jit(functools.partial(made.critic.apply, fit(jax.random.key(3)), pool.observation))
    best = np.asarray(value(demonstrated))
    others = rng.uniform(-1.0, 1.0, (200, 8)).astype(np.float32)
    assert np.mean(best > value(others)) > 0.95
    # One dimension is moved to the farther bound.
    for dimension in range(8):
        far = demonstrated.copy()
        far[:, dimension] = -np.sign(demonstrated[:, dimension])
        assert np.mean(best > value(far)) > 0.9


def test_the_large_margin_is_a_hinge_on_how_far_the_demonstrated_action_leads():
    def value(slope, observation, action):
        return slope * action[..., 0] + 0.0 * observation[..., 0]

    made = SMALL._replace(critic=Network(lambda key: jnp.zeros(()), value))

    def loss(slope, margin):
        hparams = HotStartHParams(critic="large-margin", cells=3, margin=margin)
        observation, action = np.zeros((2, 2)), np.float32([[1.0], [0.9]])
        return hot_start.critic_loss(made, slope, hparams, observation, action, np.zeros(2))[0]

    slopes, margins = np.meshgrid([0.0, 0.1, 0.5, 2.0], [0.0, 0.3, 0.8], indexing="ij")
    losses = jax.jit(jax.vmap(loss))(np.float32(slopes.ravel()), np.float32(margins.ravel()))
    leads = slopes.ravel()[:, None] * [1.0, 0.9]
    expected = np.maximum(margins.ravel()[:, None] - leads, 0.0).mean(axis=1)
    np.testing.assert_allclose(losses, expected, atol=1e-6)


def test_action_cells_are_even_along_each_dimension_with_both_bounds(skewed_spec):
    expected = [[-1.0, 1.0, 3.0], [0.5, 0.75, 1.0]]
    np.testing.assert_allclose(hot_start.action_cells(skewed_spec, 3), expected)


@pytest.fixture(scope="module")
def fitted():
    pool = pools.scripted()
    agent = ddpg.make(SPEC, networks=networks.make(SPEC, Architecture(hidden=(32, 32))))

    @jax.jit
    def fit(key, data):
        params = agent.networks.actor.init(key), agent.networks.critic.init(key)
        hparams = HotStartHParams(critic="quadratic", learning_rate=5e-3, steps=1200)
        return hot_start.fit(key, agent.networks, params, data, hparams)

    params = fit(jax.random.key(1), hot_start.data(pool, 0.99))
    return agent, pool, agent.init(jax.random.key(0), params), params


def test_the_fitted_actor_solves_the_task_it_was_shown(fitted):
    agent, _, state, _ = fitted
    evaluated = evaluation.evaluate(
        lambda observation: agent.act(state, observation), pools.ENV, pools.ENV.default_params, 10
    )
    assert evaluated.return_mean >= SPEC.reward_threshold


def test_the_quadratic_critic_comes_to_the_demonstrated_returns(fitted):
    agent, pool, state, _ = fitted
    value = jax.jit(agent.value)
    values = value(state, pool.transition.observation, pool.transition.action)
    returns = demonstrations.discounted_returns(pool, 0.99)
    assert np.corrcoef(values, returns)[0, 1] > 0.7
    far = value(state, pool.transition.observation, -pool.transition.action)
    # 20 (a_k - a_demo)^2 at a distance of 0.6.
    assert 4.0 < np.mean(np.asarray(values) - np.asarray(far)) < 10.0


def test_the_targets_are_copies_of_the_fitted_parameters(fitted):
    _, _, state, (actor, critic) = fitted
    chex.assert_trees_all_equal(state.target_actor, state.actor, actor)
    chex.assert_trees_all_equal(state.target_critic, state.critic, critic)
    pointers = [
        leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves((state.actor, state.target_actor))
    ]
    assert len(set(pointers)) == len(pointers)


@pytest.mark.parametrize("kind", ["softmax", "one-hot", "quadratic"])
def test_only_the_subset_is_read(kind):
    pool = pools.scripted()
    everything = demonstrations.episodes(pool)
    own = demonstrations.DemonstrationSubset(everything.start[3:5], everything.length[3:5])
    outside = np.ones(len(pool.episode), bool)
    outside[own.start[0] : own.start[1] + own.length[1]] = False
    poisoned = pool.transition._replace(
        observation=np.where(outside[:, None], np.nan, pool.transition.observation)
    )
    data = hot_start.data(pool, 0.99)._replace(transition=poisoned)
    hparams = HotStartHParams(critic=kind, steps=50)
    result = hot_start.fit(jax.random.key(2), SMALL, drawn(), data, hparams, subset=own)
    chex.assert_tree_all_finite(result)


def test_a_pool_can_be_passed_as_it_is():
    hparams, params = HotStartHParams(steps=3), drawn()
    pool = pools.scripted()
    direct = hot_start.fit(jax.random.key(2), SMALL, params, pool, hparams)
    prepared = hot_start.fit(jax.random.key(2), SMALL, params, hot_start.data(pool, 0.99), hparams)
    chex.assert_trees_all_equal(direct, prepared)
