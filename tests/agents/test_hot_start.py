import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from cmedirl_jax.agents import ddpg, hot_start
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.data import demonstrations
from cmedirl_jax.training import evaluation
from cmedirl_jax.types import Network
from tests.support import pools, reference
from tests.support.agents import PROBE, SMALL, SPEC, random_batch, reference_q

# Smaller than the small network's differences of values, so that one step has no loss.
MARGIN = 0.02


def reference_critic_loss(kind, critic, batch, returns, cells=5):
    grid = np.linspace(-1.0, 1.0, cells)
    total = 0.0
    for observation, action, g in zip(
        np.asarray(batch.observation), np.asarray(batch.action)[:, 0], returns, strict=True
    ):
        if kind == "monte-carlo":
            total += (reference_q(critic, observation[None], action[None, None])[0] - g) ** 2
            continue
        nearest = np.argmin(abs(grid - action))
        actions = grid.copy()
        if kind in ("one-hot", "large-margin"):
            actions[nearest] = action
        q = reference_q(critic, np.tile(observation, (cells, 1)), actions[:, None])
        if kind == "large-margin":
            total += max(q[k] + MARGIN * (k != nearest) for k in range(cells)) - q[nearest]
            continue
        target = np.eye(cells)[nearest]
        if kind == "softmax":
            q = scipy.special.softmax(q)
        if kind == "quadratic":
            target = g - 20.0 * (actions - action) ** 2
        total += np.sum((q - target) ** 2)
    return total / len(returns)


@pytest.mark.parametrize("kind", ["softmax", "one-hot", "quadratic", "monte-carlo", "large-margin"])
def test_critic_loss_and_gradient_equal_a_float64_reference(kind):
    hparams = HotStartHParams(critic=kind, cells=5, margin=MARGIN)
    batch, returns = random_batch(jax.random.key(0), 6), np.linspace(-10.0, 90.0, 6)
    critic = SMALL.critic.init(jax.random.key(1))

    def loss(critic):
        return hot_start.critic_loss(
            SMALL, critic, hparams, batch.observation, batch.action, jnp.asarray(returns)
        )[0]

    value, gradient = jax.value_and_grad(loss)(critic)

    def expected(critic):
        return reference_critic_loss(kind, critic, batch, returns)

    np.testing.assert_allclose(value, expected(reference.float64(critic)), rtol=1e-4)
    chex.assert_trees_all_close(
        gradient, reference.gradient(expected, critic), rtol=5e-3, atol=1e-3 * float(value) ** 0.5
    )


def test_the_large_margin_is_a_hinge_on_how_far_the_demonstrated_action_leads():
    def value(slope, observation, action):
        return slope * action[..., 0] + 0.0 * observation[..., 0]

    networks = SMALL._replace(critic=Network(lambda key: jnp.zeros(()), value))

    def loss(slope, margin):
        hparams = HotStartHParams(critic="large-margin", cells=3, margin=margin)
        observation, action = jnp.zeros((2, 2)), jnp.array([[1.0], [0.9]])
        return hot_start.critic_loss(networks, slope, hparams, observation, action, jnp.zeros(2))[0]

    slopes, margins = np.meshgrid([0.0, 0.1, 0.5, 2.0], [0.0, 0.3, 0.8], indexing="ij")
    losses = jax.vmap(loss)(jnp.asarray(slopes.ravel()), jnp.asarray(margins.ravel()))
    leads = slopes.ravel()[:, None] * [1.0, 0.9]
    expected = np.maximum(margins.ravel()[:, None] - leads, 0.0).mean(axis=1)
    np.testing.assert_allclose(losses, expected, atol=1e-6)


def test_action_cells_are_the_product_grid_with_both_bounds():
    spec = PROBE._replace(
        action_dim=2,
        action_low=np.array([-1.0, 0.0], np.float32),
        action_high=np.array([1.0, 2.0], np.float32),
    )
    expected = [[a, b] for a in (-1.0, 0.0, 1.0) for b in (0.0, 1.0, 2.0)]
    np.testing.assert_allclose(hot_start.action_cells(spec, 3), expected)


@pytest.fixture(scope="module")
def fitted():
    pool = pools.scripted()
    agent = ddpg.make(SPEC)
    before = agent.init(jax.random.key(0))

    def fit(key, data):
        params = (before.actor, before.critic)
        hparams = HotStartHParams(critic="quadratic", learning_rate=5e-3, steps=2000)
        return hot_start.fit(key, agent.networks, params, data, hparams)

    params = jax.jit(fit)(jax.random.key(1), hot_start.data(pool, 0.99))
    return agent, pool, agent.init(jax.random.key(0), params), params


def test_the_fitted_actor_solves_the_task_it_was_shown(fitted):
    agent, _, state, _ = fitted
    evaluated = evaluation.evaluate(
        lambda observation: agent.act(state, observation), pools.ENV, pools.ENV.default_params, 10
    )
    assert evaluated.return_mean >= SPEC.reward_threshold


def test_the_quadratic_critic_comes_to_the_demonstrated_returns(fitted):
    agent, pool, state, _ = fitted
    values = agent.value(state, pool.transition.observation, pool.transition.action)
    returns = demonstrations.discounted_returns(pool, 0.99)
    assert np.corrcoef(values, returns)[0, 1] > 0.7
    far = agent.value(state, pool.transition.observation, -pool.transition.action)
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
    params = SMALL.actor.init(jax.random.key(0)), SMALL.critic.init(jax.random.key(1))
    hparams = HotStartHParams(critic=kind, steps=50)
    result = hot_start.fit(jax.random.key(2), SMALL, params, data, hparams, subset=own)
    chex.assert_tree_all_finite(result)


def test_a_pool_can_be_passed_as_it_is():
    params = SMALL.actor.init(jax.random.key(0)), SMALL.critic.init(jax.random.key(1))
    hparams = HotStartHParams(steps=3)
    pool = pools.scripted()
    direct = hot_start.fit(jax.random.key(2), SMALL, params, pool, hparams)
    prepared = hot_start.fit(jax.random.key(2), SMALL, params, hot_start.data(pool, 0.99), hparams)
    chex.assert_trees_all_equal(direct, prepared)
