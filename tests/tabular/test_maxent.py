import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import networks, tabular
from cmedirl_jax.tabular import Stop, TabularDemonstrations
from cmedirl_jax.types import Network
from tests.support import mdps

EXACT = Stop(tolerance=1e-13)


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


@functools.partial(jax.jit, static_argnames=("discount", "horizon"))
def expert(dynamics, reward, initial, absorbing, discount=0.9, horizon=None):
    """The exact visitation of the soft-optimal policy of `reward`."""
    kwargs = {"discount": discount, "horizon": horizon, "absorbing": absorbing}
    policy = tabular.soft_value_iteration(dynamics, reward, stop=EXACT, **kwargs)
    visitation = tabular.expected_visitation(dynamics, policy, initial, stop=EXACT, **kwargs)
    return TabularDemonstrations(visitation, initial)


def two_layers(inputs, hidden=32):
    mlp = networks.MLP(hidden=(hidden,), output_dim=1)

    def init(key):
        return jax.tree.map(lambda leaf: leaf.astype(float), mlp.init(key, jnp.zeros((1, inputs))))

    return networks.scalar_output(Network(init, mlp.apply))


@functools.partial(jax.jit, static_argnames="horizon")
def two_steps(features, temperature, horizon):
    """The fit after one step and after two; the log-posterior after one, and its gradient."""
    dynamics, reward, initial, ends = mdps.random_mdp(0, absorbing=True)
    demonstrations = expert(dynamics, reward, initial, ends, horizon=horizon)
    kwargs = {"discount": 0.9, "horizon": horizon, "absorbing": ends, "stop": EXACT}
    first, second = (
        tabular.maxent_irl(
            dynamics,
            features,
            demonstrations,
            temperature=temperature,
            prior_precision=0.3,
            optimizer=optax.sgd(0.1),
            steps=steps,
            **kwargs,
        )
        for steps in (1, 2)
    )

    def log_posterior(theta):
        reward = jnp.broadcast_to((features @ theta).reshape(4, -1), (4, 3))
        policy = tabular.soft_value_iteration(dynamics, reward, temperature=temperature, **kwargs)
        value = initial @ (policy.values if horizon is None else policy.values[0])
        data = jnp.sum(demonstrations.visitation * reward) - value
        return data / temperature - 0.15 * jnp.sum(theta**2)

    return first, second, *jax.value_and_grad(log_posterior)(first.params)


@pytest.mark.parametrize("temperature", [1.0, 0.5])
@pytest.mark.parametrize("horizon", [None, 4])
@pytest.mark.parametrize("state_only", [False, True])
def test_a_step_follows_the_log_posteriors_gradient(state_only, horizon, temperature):
    """Autodiff through the whole log-likelihood, against the difference in visitation."""
    features = np.random.default_rng(1).normal(size=(4, 2) if state_only else (4, 3, 2))
    first, second, value, gradient = jax.device_get(two_steps(features, temperature, horizon))
    np.testing.assert_allclose(second.params, first.params + 0.1 * gradient, atol=1e-10)
    np.testing.assert_allclose(second.info.log_likelihood[1] + second.info.log_prior[1], value)
    if state_only:
        np.testing.assert_array_equal(first.reward, first.reward[:, :1].repeat(3, axis=1))


def test_a_reward_of_states_sees_the_sum_over_actions():
    """mu_D = sum_a mu_D^a, as below Eq. 9: only the state's visits move a reward of states."""
    dynamics, reward, initial, _ = mdps.random_mdp(1)
    demonstrations = expert(dynamics, reward, initial, None)
    backwards = np.asarray(demonstrations.visitation)[:, ::-1]
    shuffled = demonstrations._replace(visitation=backwards)

    @jax.jit
    def fitted(features, given):
        result = tabular.maxent_irl(
            dynamics, features, given, discount=0.9, optimizer=optax.sgd(0.1), steps=1
        )
        return result.params

    of_states, of_pairs = (
        [np.asarray(fitted(features, given)) for given in (demonstrations, shuffled)]
        for features in (np.eye(4), np.eye(12).reshape(4, 3, 12))
    )
    np.testing.assert_allclose(*of_states, rtol=1e-12)
    assert np.abs(of_pairs[0] - of_pairs[1]).max() > 0.01


@pytest.mark.parametrize("optimizer", [optax.adam(0.1), optax.lbfgs()], ids=["adam", "lbfgs"])
def test_the_optimum_matches_the_demonstrations_visitation(optimizer):
    dynamics, reward, initial, ends = mdps.random_mdp(2, absorbing=True)
    demonstrations = expert(dynamics, reward, initial, ends)
    features = np.eye(12).reshape(4, 3, 12)
    fit = jax.jit(
        lambda: tabular.maxent_irl(
            dynamics,
            features,
            demonstrations,
            discount=0.9,
            absorbing=ends,
            optimizer=optimizer,
            steps=400,
            stop=EXACT,
        )
    )
    result = jax.device_get(fit())
    np.testing.assert_allclose(result.visitation, demonstrations.visitation, atol=1e-4)
    assert result.info.log_likelihood[-1] >= result.info.log_likelihood.max() - 1e-9
    assert result.info.visitation_error[-1] < 1e-3 < result.info.visitation_error[0]


@functools.cache
def compiled_likelihood(horizon):
    """Its log-likelihood of demonstrations under a given reward `[S, A]`."""

    @jax.jit
    def likelihood(dynamics, reward, ends, steps, discount):
        demonstrations = tabular.empirical_visitation(*steps, reward.shape, discount=discount)
        result = tabular.deep_maxent_irl(
            jax.random.key(0),
            Network(lambda key: reward, lambda reward: reward),
            (),
            dynamics,
            demonstrations,
            discount=discount,
            horizon=horizon,
            absorbing=ends,
            optimizer=optax.sgd(0.0),
            steps=1,
            stop=EXACT,
        )
        return result.info.log_likelihood[0]

    return likelihood


@given(
    st.integers(0, 1000),
    st.booleans(),
    st.sampled_from([None, 5]),
    st.sampled_from([0.5, 0.9]),
    st.sampled_from([0.3, 30.0]),
)
def test_the_likelihood_of_demonstrations_of_any_lengths_is_never_positive(
    seed, deterministic, horizon, discount, scale
):
    """Against its sum over the steps; the episodes end in an absorbing state, or at the horizon."""
    dynamics, reward, _, ends = mdps.random_mdp(seed, deterministic=deterministic, absorbing=True)
    reward = scale * reward
    demonstrations = mdps.demonstrate(dynamics, [0, 1, 2, 1], horizon or 60, ends, seed)
    _, policy = mdps.soft_backups(dynamics, reward, discount, horizon or 200, absorbing=ends)
    expected = np.mean(
        [
            sum(
                discount**time * np.log(policy[time if horizon else 0][pair])
                for time, pair in enumerate(pairs)
            )
            for pairs in demonstrations
        ]
    )
    steps = mdps.padded(demonstrations, 60)
    with jax.enable_x64(True):
        found = compiled_likelihood(horizon)(dynamics, reward, ends, steps, discount)
    assert found <= 0.0
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_the_likelihood_equals_that_among_all_trajectories():
    """Undiscounted and deterministic: exp(return) over the sum of that from the same start."""
    dynamics, reward, _, ends = mdps.random_mdp(5, deterministic=True, absorbing=True)
    demonstrations = mdps.demonstrate(dynamics, [0, 1, 2, 1, 0], 5, ends, seed=1)
    assert len({len(pairs) for pairs in demonstrations}) > 2
    logs = []
    for pairs in demonstrations:
        every = mdps.trajectories(dynamics, np.ones((5, 4, 3)), np.eye(4)[pairs[0][0]], ends)
        returns = [sum(reward[pair] for pair in path) for weight, path in every if weight]
        logs.append(sum(reward[pair] for pair in pairs) - np.log(np.sum(np.exp(returns))))
    steps = mdps.padded(demonstrations, 60)
    found = compiled_likelihood(5)(dynamics, reward, ends, steps, 1.0)
    np.testing.assert_allclose(found, np.mean(logs), rtol=1e-9)


CELLS = 25
ROW, COLUMN = np.divmod(np.arange(CELLS), 5)
SWAMP = np.where((ROW == 2) & (COLUMN < 3), -6.0, -2.0)[:, None].repeat(4, axis=1)
"""A reward of the gridworld."""


@functools.cache
def sampled(slip):
    """The gridworld, its optimal policy, and 1,000 episodes of that."""
    dynamics, ends = mdps.gridworld(5, slip)
    starts = np.full(CELLS, ~ends / (CELLS - 1))
    solve = jax.jit(functools.partial(tabular.soft_value_iteration, discount=0.95, stop=EXACT))
    ideal = jax.device_get(solve(dynamics, SWAMP, absorbing=ends))
    rng = np.random.default_rng(0)
    episodes = np.zeros((1000, 100, 2), int)
    mask = np.zeros((1000, 100), bool)
    for episode in range(1000):
        state = rng.choice(CELLS, p=starts)
        for time in range(100):
            if ends[state]:
                break
            action = rng.choice(4, p=np.exp(ideal.log_probabilities[state]))
            episodes[episode, time], mask[episode, time] = (state, action), True
            state = rng.choice(CELLS, p=dynamics[state, action])
    return dynamics, ends, starts, ideal, (*np.moveaxis(episodes, -1, 0), mask)


@functools.cache
def compiled_recovery(deep):
    """The values of the policy that the fitted reward induces, and of another one."""

    @jax.jit
    def recover(dynamics, ends, starts, ideal, steps):
        kwargs = {"discount": 0.95, "absorbing": ends}
        fit = (
            functools.partial(
                tabular.deep_maxent_irl, jax.random.key(0), two_layers(CELLS), (np.eye(CELLS),)
            )
            if deep
            else functools.partial(tabular.maxent_irl, features=np.eye(CELLS))
        )
        demonstrations = tabular.empirical_visitation(*steps, (CELLS, 4), discount=0.95)
        result = fit(
            dynamics=dynamics, demonstrations=demonstrations, prior_precision=1e-4, **kwargs
        )

        def value(policy):
            mu = tabular.expected_visitation(dynamics, policy, starts, **kwargs)
            return jnp.sum(mu * (SWAMP - policy.log_probabilities))

        return value(result.policy), value(ideal)

    return recover


@pytest.mark.parametrize("slip", [0.0, 0.2])
@pytest.mark.parametrize("deep", [False, True], ids=["linear", "deep"])
def test_the_reward_of_a_gridworld_is_recovered(deep, slip):
    """From 1,000 sampled episodes: the policy it induces has 0.99 of the expert's value."""
    found_value, ideal_value = compiled_recovery(deep)(*sampled(slip))
    # The values include entropy, so that the expert's is the largest; both are negative.
    assert ideal_value / 0.99 <= found_value <= ideal_value < -5.0


def test_seeds_vmap():
    dynamics, reward, initial, ends = mdps.random_mdp(3, absorbing=True)
    network = two_layers(3, hidden=4)
    places = np.random.default_rng(0).normal(size=(4, 3))
    every = [expert(dynamics, scale * reward, initial, ends) for scale in (0.5, 1.0, 2.0)]
    keys = jax.random.split(jax.random.key(0), 3)

    def fit(key, demonstrations):
        result = tabular.deep_maxent_irl(
            key, network, (places,), dynamics, demonstrations, discount=0.9, absorbing=ends, steps=5
        )
        return result.reward, result.visitation

    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *every)
    together = jax.device_get(jax.jit(jax.vmap(fit))(keys, stacked))
    alone = jax.jit(fit)
    for index, demonstrations in enumerate(every):
        one = jax.tree.map(lambda leaf, index=index: leaf[index], together)
        chex.assert_trees_all_close(one, alone(keys[index], demonstrations), rtol=1e-5, atol=1e-6)
