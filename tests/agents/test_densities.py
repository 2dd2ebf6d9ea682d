import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from cmedirl_jax.agents import densities
from tests.support import pools, reference

BOUNDS = np.float32([-1.0, 0.5]), np.float32([3.0, 1.0])
SPEC = pools.ENV.spec._replace(action_dim=2, action_low=BOUNDS[0], action_high=BOUNDS[1])
MEAN, SCALE = np.float32([0.4, 1.1]), np.float32([0.9, 0.2])
ACTIONS = np.float32([[0.3, 0.6], [-1.0, 0.7], [3.0, 0.5], [2.0, 1.0], [-1.0, 1.0]])

clipped_normal = jax.jit(lambda *args: densities.clipped_normal(SPEC, *args))
epsilon_greedy = jax.jit(lambda *args: densities.epsilon_greedy(SPEC, *args))
transition_mixture = jax.jit(densities.transition_mixture)
trajectory_mixture = jax.jit(densities.trajectory_mixture)
fit_gaussian = jax.jit(lambda *args: densities.fit_gaussian(SPEC, *args))
gaussian_policy = jax.jit(lambda *args: densities.gaussian_policy(SPEC, *args))


def scipys(action, mean=MEAN, scale=SCALE):
    law = scipy.stats.norm(np.float64(mean), np.float64(scale))
    low, high = BOUNDS
    at = [action <= low, action >= high]
    return np.select(at, [law.logcdf(low), law.logsf(high)], law.logpdf(action)).sum(axis=-1)


def test_a_clipped_normals_density_is_scipys():
    np.testing.assert_allclose(clipped_normal(MEAN, SCALE, ACTIONS), scipys(ACTIONS), rtol=1e-5)


def test_a_distant_bound_keeps_its_density():
    log_density = clipped_normal(np.float32([-0.9, 0.55]), np.float32([0.1, 0.02]), ACTIONS)
    expected = scipys(ACTIONS, np.float32([-0.9, 0.55]), np.float32([0.1, 0.02]))
    assert expected.min() < -700
    np.testing.assert_allclose(log_density, expected, rtol=1e-4)


def test_epsilon_greedys_density_is_the_mixtures():
    volume = 4.0 * 0.5
    inside = np.array([True, False, False, False, False])
    expected = np.log(0.3 * inside / volume + 0.7 * np.exp(scipys(ACTIONS)))
    np.testing.assert_allclose(epsilon_greedy(0.3, MEAN, ACTIONS, SCALE), expected, rtol=1e-5)
    without = epsilon_greedy(0.3, ACTIONS[3], ACTIONS)
    np.testing.assert_allclose(without, np.where(np.arange(5) == 3, np.inf, np.log(0.15)), 1e-6)


@pytest.mark.parametrize(
    "log_density",
    [
        lambda action: clipped_normal(MEAN, SCALE, action),
        lambda action: epsilon_greedy(0.3, MEAN, action, SCALE),
    ],
    ids=["clipped_normal", "epsilon_greedy"],
)
def test_densities_integrate_to_one_over_the_base_measure(log_density):
    action, weight = reference.base_measure(SPEC, 60)
    total = weight @ np.exp(np.float64(log_density(action.astype(np.float32))))
    assert total == pytest.approx(1.0, abs=1e-5)


log_values = st.floats(-200, 200, width=32) | st.sampled_from([-np.inf, np.inf])
log_densities = arrays.arrays(np.float32, (3, 2, 5), elements=log_values)
masks = arrays.arrays(bool, (2, 5))


def mean_of_densities(values, filled):
    """log mean_k exp over the filled components; an infinite one makes it infinite."""
    values = np.float64(values)[np.array(filled)]
    finite = np.where(values == np.inf, 0.0, values)
    mixed = scipy.special.logsumexp(finite, axis=0) - np.log(len(values))
    return np.where((values == np.inf).any(axis=0), np.inf, mixed)


def brute_force_trajectory(values, steps, filled):
    total = np.zeros(values.shape[:-1])
    for index in np.ndindex(total.shape):
        taken = [float(x) for x, step in zip(values[index], steps[index[1:]], strict=True) if step]
        total[index] = -np.inf if -np.inf in taken else sum(taken)
    return mean_of_densities(total, filled)


filled_components = st.lists(st.booleans(), min_size=3, max_size=3).filter(any)


@pytest.mark.filterwarnings("ignore:divide by zero")
@given(values=log_densities, filled=filled_components)
def test_a_mixture_of_transitions_is_the_mean_density(values, filled):
    # Components that are not filled may hold any value.
    values[~np.array(filled)] = np.nan
    log_density = transition_mixture(values, np.array(filled))
    np.testing.assert_allclose(log_density, mean_of_densities(values, filled), rtol=1e-5, atol=1e-4)


@pytest.mark.filterwarnings("ignore:divide by zero")
@given(values=log_densities, steps=masks, filled=filled_components)
def test_a_mixture_of_trajectories_is_the_mean_of_their_densities(values, steps, filled):
    values[~np.array(filled)] = np.nan
    values[:, ~steps] = np.nan
    log_density = trajectory_mixture(values, steps, np.array(filled))
    expected = brute_force_trajectory(values, steps, filled)
    np.testing.assert_allclose(log_density, expected, rtol=1e-5, atol=1e-3)


def test_all_components_are_the_default():
    values = np.float32(np.random.default_rng(0).normal(size=(3, 2, 5)))
    everything = np.ones((2, 5), bool)
    expected = mean_of_densities(values, [True] * 3)
    np.testing.assert_allclose(transition_mixture(values), expected, rtol=1e-5, atol=1e-6)
    expected = mean_of_densities(np.float64(values).sum(axis=-1), [True] * 3)
    np.testing.assert_allclose(trajectory_mixture(values, everything), expected, rtol=1e-5)


def test_a_mixture_of_trajectories_is_not_one_of_steps():
    """Two policies, each certain of its own action: a trajectory never mixes the two."""
    sure = np.log(np.float32([[0.9, 0.1], [0.1, 0.9]]))
    steps = np.ones(2, bool)
    assert trajectory_mixture(sure, steps) == pytest.approx(np.log(0.09))
    assert transition_mixture(sure).sum() == pytest.approx(np.log(0.25))


def test_mixtures_of_several_policies_estimate_the_partition_function():
    """For trajectories of two steps, each drawn from one of two policies, and for single steps."""
    rng = np.random.default_rng(0)
    means = np.float32([[0.0, 0.6], [2.5, 0.9]])
    scale = np.float32([1.4, 0.4])
    policy = rng.integers(0, 2, 20_000)
    action = means[policy, None] + scale * rng.normal(size=(len(policy), 2, 2))
    action = np.clip(action, *BOUNDS).astype(np.float32)
    recorded = jax.vmap(clipped_normal, in_axes=(0, None, None))(means, scale, action)

    def reward(action):
        return np.float64(action) @ [0.6, 1.0]

    points, weight = reference.base_measure(SPEC, 60)
    z = weight @ np.exp(reward(points))

    def deviation(log_density, reward, expected):
        estimates = np.exp(reward - np.float64(log_density))
        error = estimates.std() / len(estimates) ** 0.5
        assert error < 0.02 * expected
        return abs(estimates.mean() - expected) / error

    of_steps = transition_mixture(recorded)
    total = reward(action).sum(axis=-1)
    assert deviation(of_steps[:, 0], reward(action[:, 0]), z) < 4
    assert deviation(trajectory_mixture(recorded, np.ones((20_000, 2), bool)), total, z**2) < 4
    # Means taken step by step are for other trajectories, and give another Z.
    assert deviation(of_steps.sum(axis=-1), total, z**2) > 10


def pairs(n=400, seed=0):
    """Observations of MountainCar's sizes, and noisy actions affine in them."""
    rng = np.random.default_rng(seed)
    observation = rng.uniform(SPEC.observation_low, SPEC.observation_high, (n, 2))
    truth = np.array([[0.8, 0.7], [0.5, -0.1], [12.0, 1.5]])
    noise = rng.normal(size=(n, 2)) * [0.3, 0.05]
    action = np.column_stack([np.ones(n), observation]) @ truth + noise
    return observation.astype(np.float32), np.clip(action, *BOUNDS).astype(np.float32)


def least_squares(observation, action, weight):
    design = np.column_stack([np.ones(len(action)), np.float64(observation)])
    root = np.sqrt(np.float64(weight))[:, None]
    coefficients = np.linalg.lstsq(root * design, root * action, rcond=None)[0]
    residual = action - design @ coefficients
    return coefficients, np.sqrt(np.average(residual**2, axis=0, weights=weight))


@pytest.mark.parametrize("weighted", [False, True])
def test_the_fitted_gaussian_is_float64_least_squares(weighted):
    observation, action = pairs()
    weight = np.random.default_rng(1).integers(0, 3, len(action)) if weighted else np.ones(400)
    fitted = fit_gaussian(observation, action, np.float32(weight) if weighted else None)
    coefficients, scale = least_squares(observation, action, weight)
    np.testing.assert_allclose(fitted.coefficients, coefficients, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(fitted.scale, scale, rtol=1e-4)

    mean = np.column_stack([np.ones(len(action)), observation]) @ coefficients
    np.testing.assert_allclose(
        gaussian_policy(fitted, observation, action),
        scipys(action, mean, scale),
        rtol=1e-3,
        atol=1e-3,
    )


def test_fits_vmap_over_the_weights():
    observation, action = pairs(40)
    weights = np.float32(np.arange(40) % 2 == np.arange(2)[:, None])
    fitted = jax.vmap(fit_gaussian, in_axes=(None, None, 0))(observation, action, weights)
    for index, weight in enumerate(weights):
        expected = least_squares(observation, action, weight)[0]
        np.testing.assert_allclose(fitted.coefficients[index], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("observation", [0.3, -0.07])
def test_actions_without_noise_at_one_state_give_the_smallest_scale(observation):
    observation, action = np.full((40, 2), observation, np.float32), np.tile(MEAN, (40, 1))
    fitted = fit_gaussian(observation, action)
    np.testing.assert_allclose(fitted.coefficients, [MEAN, [0, 0], [0, 0]], atol=1e-6)
    np.testing.assert_allclose(fitted.scale, densities.SCALE_FLOOR * np.array([2.0, 0.25]))
    assert np.isfinite(gaussian_policy(fitted, observation[0], ACTIONS)).all()


def test_the_fit_calls_no_lapack():
    """LAPACK can deadlock on Python's lock when several CPU devices run ahead of the host."""
    text = fit_gaussian.lower(np.ones((4, 2), np.float32), np.ones((4, 1), np.float32), None)
    assert "lapack" not in text.as_text().lower()
    solved = jax.jit(jnp.linalg.lstsq).lower(np.ones((4, 2), np.float32), np.ones((4, 1)))
    assert "lapack" in solved.as_text().lower()
