import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import tabular
from cmedirl_jax.tabular import Stop
from tests.support import mdps

EXACT = Stop(tolerance=1e-14)
HORIZONS = [1, 3, 7]


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


# Jitted once here: otherwise every call would compile its loops.
soft_value_iteration = jax.jit(tabular.soft_value_iteration, static_argnames="horizon")
expected_visitation = jax.jit(tabular.expected_visitation, static_argnames="horizon")


def soft(dynamics, reward, **kwargs):
    return soft_value_iteration(dynamics, reward, **{"discount": 0.9, "stop": EXACT, **kwargs})


def visits(dynamics, policy, initial, **kwargs):
    kwargs = {"discount": 0.9, "stop": EXACT, **kwargs}
    return expected_visitation(dynamics, policy, initial, **kwargs)


@pytest.mark.parametrize("absorbing", [False, True])
@pytest.mark.parametrize(("discount", "temperature"), [(1.0, 1.0), (0.7, 0.3), (0.95, 2.0)])
def test_values_and_policy_follow_the_recursion(discount, temperature, absorbing):
    dynamics, reward, _, ends = mdps.random_mdp(0, absorbing=absorbing)
    solution = soft(
        dynamics, reward, discount=discount, horizon=5, temperature=temperature, absorbing=ends
    )
    values, policy = mdps.soft_backups(dynamics, reward, discount, 5, temperature, ends)
    np.testing.assert_allclose(solution.values, values, rtol=1e-12)
    np.testing.assert_allclose(np.exp(solution.log_probabilities), policy, rtol=1e-12)
    following = np.concatenate([values[1:], np.zeros((1, len(reward)))])
    q = reward + discount * np.einsum("sat,ht->hsa", dynamics, following)
    np.testing.assert_allclose(solution.action_values, q, rtol=1e-12)
    assert solution.residual == 0


def test_the_value_sums_over_all_paths():
    """Undiscounted and deterministic: V_0(s) = log sum over paths of exp(their return)."""
    dynamics, reward, _, _ = mdps.random_mdp(1, deterministic=True)
    solution = soft(dynamics, reward, discount=1.0, horizon=4)
    uniform = np.ones((4, *reward.shape))
    for state in range(len(reward)):
        paths = mdps.trajectories(dynamics, uniform, np.eye(len(reward))[state])
        total = sum(
            np.exp(sum(reward[pair] for pair in pairs)) for weight, pairs in paths if weight
        )
        np.testing.assert_allclose(solution.values[0, state], np.log(total), rtol=1e-12)


@pytest.mark.parametrize("absorbing", [False, True])
@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("discount", [1.0, 0.6])
def test_visitation_equals_the_sum_over_all_trajectories(discount, deterministic, absorbing):
    dynamics, reward, initial, ends = mdps.random_mdp(2, 3, 2, deterministic, absorbing)
    policy = soft(dynamics, reward, discount=discount, horizon=5, absorbing=ends)
    visited = visits(dynamics, policy, initial, discount=discount, horizon=5, absorbing=ends)
    every = mdps.trajectories(dynamics, np.exp(policy.log_probabilities), initial, ends)
    expected = mdps.counted_visits(every, discount, reward.shape)
    np.testing.assert_allclose(visited, expected, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("absorbing", [False, True])
def test_fixed_points_equal_matrix_solves(absorbing):
    dynamics, reward, initial, ends = mdps.random_mdp(3, 6, absorbing=absorbing)
    policy = jax.device_get(soft(dynamics, reward, absorbing=ends))
    probabilities = np.exp(policy.log_probabilities)
    if absorbing:
        probabilities[ends] = 0.0
    moves = np.einsum("sa,sat->st", probabilities, dynamics)
    occupancy = np.linalg.solve(np.eye(6) - 0.9 * moves.T, initial)
    visited = visits(dynamics, policy, initial, absorbing=ends)
    np.testing.assert_allclose(visited, occupancy[:, None] * probabilities, rtol=1e-10)
    # The policy's own value: its rewards and its entropy.
    entropy = -np.sum(probabilities * policy.log_probabilities, axis=1)
    value = np.linalg.solve(
        np.eye(6) - 0.9 * moves, np.sum(probabilities * reward, axis=1) + entropy
    )
    np.testing.assert_allclose(policy.values, value, rtol=1e-10, atol=1e-12)
    assert policy.residual <= EXACT.tolerance


@given(st.integers(0, 1000), st.booleans(), st.sampled_from([None, 3]))
def test_sparse_equals_dense(seed, absorbing, horizon):
    dynamics, reward, initial, ends = mdps.random_mdp(seed, absorbing=absorbing)
    solutions = []
    with jax.enable_x64(True):
        for kind in (dynamics, mdps.sparse(dynamics)):
            policy = soft(kind, reward, horizon=horizon, absorbing=ends)
            solutions.append(
                (policy, visits(kind, policy, initial, horizon=horizon, absorbing=ends))
            )
    chex.assert_trees_all_close(*solutions, rtol=1e-9, atol=1e-12)


@functools.partial(jax.jit, static_argnames="horizon")
def likelihoods_gradient(dynamics, reward, weights, index, **kwargs):
    """Of the sum of weight * log pi_t(a_t | s_t) over the steps of `index`."""

    def likelihood(reward):
        return weights @ soft(dynamics, reward, **kwargs).log_probabilities[index]

    return jax.grad(likelihood)(reward)


def weighted_steps(shares, discount, horizon):
    """Each step's probability * gamma^t, and its place `(t, s, a)` in a policy, or `(s, a)`."""
    weights, steps = [], []
    for probability, pairs in shares:
        for time, pair in enumerate(pairs):
            weights.append(probability * discount**time)
            steps.append(pair if horizon is None else (time, *pair))
    return np.array(weights), tuple(np.array(steps).T)


@pytest.mark.parametrize(
    ("discount", "horizon", "absorbing"),
    [
        *itertools.product([1.0, 0.9, 0.5], HORIZONS, [False, True]),
        *itertools.product([0.9, 0.5], [None], [True]),
    ],
)
def test_the_likelihoods_gradient_is_the_difference_in_visitation(discount, horizon, absorbing):
    """Eq. 8, exact for deterministic dynamics and the demonstrations' own starts.

    Without a horizon the demonstrations have to end by themselves.
    """
    dynamics, reward, _, ends = mdps.random_mdp(4, 5, deterministic=True, absorbing=absorbing)
    starts = [0, 1, 1, 3, 2, 0]
    demonstrations = mdps.demonstrate(dynamics, starts, horizon or 1000, ends, seed=0)
    kwargs = {"discount": discount, "horizon": horizon, "absorbing": ends}
    shares = [(1 / len(demonstrations), pairs) for pairs in demonstrations]
    steps = weighted_steps(shares, discount, horizon)
    gradient = likelihoods_gradient(dynamics, reward, *steps, **kwargs)
    initial = np.bincount(starts, minlength=5) / len(starts)
    expected = mdps.counted_visits(shares, discount, reward.shape) - visits(
        dynamics, soft(dynamics, reward, **kwargs), initial, **kwargs
    )
    np.testing.assert_allclose(gradient, expected, atol=1e-9)
    assert np.abs(expected).max() > 0.05


@pytest.mark.parametrize("horizon", HORIZONS)
def test_with_stochastic_dynamics_it_holds_in_expectation(horizon):
    """The likelihood of all trajectories of another policy, each with its probability."""
    dynamics, reward, initial, ends = mdps.random_mdp(6, 3, 2, absorbing=True)
    other = np.random.default_rng(0).dirichlet(np.ones(2), (horizon, 3))
    horizon = min(horizon, 4)
    every = list(mdps.trajectories(dynamics, other[:horizon], initial, ends))
    kwargs = {"discount": 0.8, "horizon": horizon, "absorbing": ends}
    gradient = likelihoods_gradient(
        dynamics, reward, *weighted_steps(every, 0.8, horizon), **kwargs
    )
    policy = soft(dynamics, reward, **kwargs)
    expected = mdps.counted_visits(every, 0.8, reward.shape) - visits(
        dynamics, policy, initial, **kwargs
    )
    np.testing.assert_allclose(gradient, expected, atol=1e-9)


@pytest.mark.parametrize("mode", ["fwd", "rev"])
def test_fixed_points_are_differentiable(mode):
    """Against central differences, of the value and of the visitation."""
    dynamics, reward, initial, ends = mdps.random_mdp(7, absorbing=True)
    weights = np.random.default_rng(0).normal(size=reward.shape)

    @jax.jit
    def measure(reward):
        policy = soft(dynamics, reward, absorbing=ends)
        return initial @ policy.values + jnp.sum(
            weights * visits(dynamics, policy, initial, absorbing=ends)
        )

    jax.test_util.check_grads(measure, (jnp.asarray(reward),), order=1, modes=[mode], rtol=1e-6)


def test_reaching_the_limit_on_iterations_shows_in_the_residual():
    dynamics, reward, _, _ = mdps.random_mdp(8)
    solution = soft(dynamics, reward, discount=0.999, stop=Stop(1e-14, iterations=20))
    assert 1e-4 < solution.residual < 1.0


def test_a_good_guess_is_not_iterated_further():
    dynamics, reward, initial, _ = mdps.random_mdp(9)
    policy = soft(dynamics, reward)
    once = Stop(1e-14, iterations=1)
    again = soft(dynamics, reward, guess=policy.values, stop=once)
    np.testing.assert_allclose(again.values, policy.values, rtol=1e-12)
    mu = visits(dynamics, policy, initial)
    np.testing.assert_allclose(
        visits(dynamics, policy, initial, guess=mu.sum(1), stop=once), mu, rtol=1e-12
    )


def test_vmaps_over_rewards_and_does_not_recompile():
    dynamics, reward, initial, ends = mdps.random_mdp(10, absorbing=True)

    @jax.jit
    @functools.partial(chex.assert_max_traces, n=1)
    def both(rewards):
        def one(reward):
            policy = soft(dynamics, reward, absorbing=ends)
            return policy.values, visits(dynamics, policy, initial, absorbing=ends)

        return jax.vmap(one)(rewards)

    rewards = np.stack([reward, 3.0 * reward, -reward])
    values, mu = jax.device_get(both(rewards))
    both(2.0 * rewards)
    for index, reward in enumerate(rewards):
        policy = soft(dynamics, reward, absorbing=ends)
        np.testing.assert_allclose(values[index], policy.values, rtol=1e-9)
        np.testing.assert_allclose(
            mu[index], visits(dynamics, policy, initial, absorbing=ends), rtol=1e-9, atol=1e-12
        )


def test_wrong_shapes_are_refused():
    dynamics, reward, initial, _ = mdps.random_mdp(11)
    with pytest.raises(ValueError, match=r"reward \[S, A\] and dynamics .*got \(4, 2\)"):
        soft(dynamics, reward[:, :2])
    with pytest.raises(ValueError, match=r"got \(4, 3\)"):
        soft(mdps.sparse(dynamics)._replace(probability=dynamics[..., :2]), reward)
    policy = soft(dynamics, reward, horizon=3)
    for horizon in (None, 4):
        with pytest.raises(ValueError, match=f"a policy of horizon {horizon}"):
            visits(dynamics, policy, initial, horizon=horizon)
