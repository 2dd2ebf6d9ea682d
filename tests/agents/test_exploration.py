import functools
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import envs
from cmedirl_jax.agents import exploration
from cmedirl_jax.agents.exploration import (
    EpsilonGreedyHParams,
    GaussianHParams,
    OrnsteinUhlenbeckHParams,
)
from tests.support import reference

SPEC = envs.make("MountainCarContinuous-v0").spec._replace(
    action_low=np.array([-1.0], np.float32), action_high=np.array([3.0], np.float32)
)
LOW, HIGH = SPEC.action_low[0], SPEC.action_high[0]
HALF_WIDTH = 2.0
KEY = jax.random.key(0)
HELD_NOISE = 0.6


def gaussian(spec=SPEC):
    behaviour = exploration.gaussian(spec, GaussianHParams(scale=0.4))
    return behaviour, behaviour.init(KEY), 0.0


def ornstein_uhlenbeck(spec=SPEC):
    behaviour = exploration.ornstein_uhlenbeck(
        spec, OrnsteinUhlenbeckHParams(theta=0.25, sigma=0.4)
    )
    state = behaviour.init(KEY)
    state = state.replace(value=jnp.full_like(state.value, HELD_NOISE))
    return behaviour, state, 0.75 * HELD_NOISE


noisy = pytest.mark.parametrize(
    "made", [gaussian(), ornstein_uhlenbeck()], ids=["gaussian", "ornstein_uhlenbeck"]
)
greedy_actions = pytest.mark.parametrize("mu", [-1.0, 0.2, 2.9])
EPSILON_GREEDY = exploration.epsilon_greedy(SPEC)


@functools.cache
def jitted(perturb):
    return jax.jit(jax.vmap(perturb, in_axes=(None, None, 0, None)))


def perturb(behaviour, state, mu, noise, step=0):
    """Actions and log densities for many noises `[B, A]`, at one greedy action."""
    mu = np.atleast_1d(np.float32(mu))
    return jax.device_get(jitted(behaviour.perturb)(state, mu, noise, step))[:2]


@functools.cache
def sampler(sample):
    return jax.jit(jax.vmap(sample, in_axes=(0, None, None, None)))


@noisy
@greedy_actions
def test_clipped_normal_density_integrates_to_one(made, mu):
    behaviour, state, shift = made
    scale = 0.4 * HALF_WIDTH
    cell = (HIGH - LOW) / 2000
    wanted = LOW + cell * (np.arange(2000) + 0.5)
    noise = np.float32(np.r_[(wanted - (mu + shift)) / scale, -20.0, 20.0])
    action, log_density = perturb(behaviour, state, mu, noise[:, None])
    np.testing.assert_allclose(action[:-2, 0], wanted, atol=1e-5)
    np.testing.assert_array_equal(action[-2:, 0], [LOW, HIGH])
    density = np.exp(np.float64(log_density))
    assert cell * density[:-2].sum() + density[-2:].sum() == pytest.approx(1.0, abs=1e-5)


@noisy
@greedy_actions
def test_clipped_normal_density_is_scipys(made, mu):
    behaviour, state, shift = made
    law = scipy.stats.norm(mu + shift, 0.4 * HALF_WIDTH)
    noise = np.linspace(-6, 6, 2002, dtype=np.float32)[:, None]
    action, log_density = perturb(behaviour, state, mu, noise)
    action = np.float64(action[:, 0])
    expected = np.select(
        [action == LOW, action == HIGH], [law.logcdf(LOW), law.logsf(HIGH)], law.logpdf(action)
    )
    np.testing.assert_allclose(log_density, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("make", [gaussian, ornstein_uhlenbeck])
def test_densities_of_independent_dimensions_multiply(make, skewed_spec):
    behaviour, state, shift = make(skewed_spec)
    mu = np.array([0.0, 0.9], np.float32)
    action, log_density = perturb(behaviour, state, mu, np.float32([[0.3, 8.0]]))
    law = scipy.stats.norm(mu + shift, 0.4 * np.array([2.0, 0.25]))
    assert action[0, 1] == skewed_spec.action_high[1]
    expected = law.logpdf(action[0])[0] + law.logsf(skewed_spec.action_high)[1]
    np.testing.assert_allclose(log_density[0], expected, rtol=1e-5)


@noisy
@greedy_actions
def test_samples_follow_the_clipped_normal(made, mu):
    behaviour, state, shift = made
    sample = sampler(behaviour.sample)
    action, _, _ = sample(jax.random.split(KEY, 20_000), state, np.float32([mu]), 0)
    action = np.asarray(action[:, 0])
    law = scipy.stats.norm(mu + shift, 0.4 * HALF_WIDTH)
    below = [(action <= x).mean() for x in np.linspace(LOW, HIGH, 40)[:-1]]
    expected = law.cdf(np.linspace(LOW, HIGH, 40))
    # The Kolmogorov-Smirnov distance with a p-value of 0.001.
    np.testing.assert_allclose([*below, (action < HIGH).mean()], expected, atol=1.95 / 20_000**0.5)


def test_ornstein_uhlenbeck_has_the_closed_form_variance_and_autocorrelation():
    behaviour = exploration.ornstein_uhlenbeck(SPEC)

    def advance(state, noise):
        _, _, state = behaviour.perturb(state, jnp.zeros(1), noise, 0)
        return state, state.value[0]

    noise = jax.random.normal(KEY, (2000, 100, 1))
    states = jax.vmap(behaviour.init)(jax.random.split(KEY, 100))
    _, values = jax.lax.scan(jax.vmap(advance), states, noise)
    values = np.asarray(values, np.float64)[100:]
    variance = np.mean(values**2)
    decay = 1 - 0.15
    assert variance == pytest.approx((0.5 * HALF_WIDTH) ** 2 / (1 - decay**2), rel=0.03)
    for lag in (1, 5, 10):
        correlation = np.mean(values[lag:] * values[:-lag]) / variance
        assert correlation == pytest.approx(decay**lag, abs=0.02)


def test_ornstein_uhlenbecks_marginal_density_is_of_the_stationary_law():
    behaviour = exploration.ornstein_uhlenbeck(SPEC)
    action = np.float32([[LOW], [0.3], [2.0], [HIGH]])
    log_density = jax.jit(behaviour.log_density)(behaviour.init(KEY), np.float32([0.5]), action, 0)
    law = scipy.stats.norm(0.5, 0.5 * HALF_WIDTH / np.sqrt(1 - 0.85**2))
    expected = [law.logcdf(LOW), *law.logpdf(action[1:3, 0]), law.logsf(HIGH)]
    np.testing.assert_allclose(log_density, expected, rtol=1e-5)


def test_ornstein_uhlenbeck_filters_its_noise():
    behaviour = exploration.ornstein_uhlenbeck(SPEC)
    noise = np.asarray(jax.random.normal(KEY, (50, 1)))

    def advance(state, noise):
        action, _, state = behaviour.perturb(state, jnp.float32([0.5]), noise, 0)
        return state, action[0]

    _, actions = jax.lax.scan(advance, behaviour.init(KEY), noise)
    path = scipy.signal.lfilter([0.5 * HALF_WIDTH], [1, -0.85], np.float64(noise[:, 0]))
    np.testing.assert_allclose(actions, np.clip(0.5 + path, LOW, HIGH), atol=1e-5)


def test_noise_starts_again_at_zero_in_each_episode():
    behaviour, state, _ = ornstein_uhlenbeck()
    assert state.value == HELD_NOISE
    fresh = behaviour.reset(state)
    assert not fresh.value.any()
    assert fresh.hparams == state.hparams


SCHEDULE = [(0, 1.0), (1250, 0.7525), (2500, 0.505), (5000, 0.01), (12_000, 0.01)]


@pytest.mark.parametrize(("step", "epsilon"), SCHEDULE)
def test_epsilon_falls_linearly_and_stays(step, epsilon):
    choices = (np.arange(10_000) + 0.5) / 10_000
    noise = (choices.astype(np.float32), np.full((10_000, 1), 2.5, np.float32), None)
    action, _ = perturb(EPSILON_GREEDY, EPSILON_GREEDY.init(KEY), 0.0, noise, step)
    assert np.mean(action == 2.5) == pytest.approx(epsilon, abs=2e-4)


@pytest.mark.parametrize(("step", "epsilon"), SCHEDULE)
def test_epsilon_greedy_densities(step, epsilon):
    noise = (np.array([0.0, 1.0], np.float32), np.full((2, 1), 2.5, np.float32), None)
    action, log_density = perturb(EPSILON_GREEDY, EPSILON_GREEDY.init(KEY), 0.0, noise, step)
    np.testing.assert_array_equal(action[:, 0], [2.5, 0.0])
    expected = [epsilon / (HIGH - LOW), np.inf]
    np.testing.assert_allclose(np.exp(log_density), expected, rtol=1e-5)


def test_random_actions_are_uniform_in_the_bounds():
    action, _, _ = sampler(EPSILON_GREEDY.sample)(
        jax.random.split(KEY, 10_000), EPSILON_GREEDY.init(KEY), np.zeros(1, np.float32), 2500
    )
    action = np.asarray(action[:, 0])
    random = action[action != 0.0]
    assert scipy.stats.binomtest(len(random), 10_000, 0.505).pvalue > 1e-3
    assert scipy.stats.kstest(random, "uniform", (LOW, HIGH - LOW)).pvalue > 1e-3


@pytest.mark.parametrize("hold", [1, 3, 8])
def test_random_actions_are_held_for_exactly_hold_steps(hold):
    behaviour = exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(hold=float(hold)))
    state = behaviour.init(KEY)
    actions, log_densities = [], []
    for offered in range(hold + 2):
        # Only the first choice is random: a held action must ignore those offered later.
        noise = (jnp.float32(offered > 0), jnp.float32([2.0 + 0.01 * offered]), None)
        action, log_density, state = behaviour.perturb(state, jnp.zeros(1), noise, 2500)
        actions.append(float(action[0]))
        log_densities.append(float(log_density))
    assert actions == [2.0] * hold + [0.0] * 2
    log_volume = math.log(HIGH - LOW)
    expected = [math.log(0.505) - log_volume] + [-log_volume] * (hold - 1) + [math.inf] * 2
    np.testing.assert_allclose(log_densities, expected, rtol=1e-5)


@pytest.mark.parametrize(("step", "epsilon"), SCHEDULE)
@pytest.mark.parametrize("hold", [1, 4])
def test_epsilon_greedys_marginal_density_is_of_the_random_actions_share(step, epsilon, hold):
    behaviour = exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(hold=hold))
    action = np.float32([[0.3], [2.0]])
    log_density = behaviour.log_density(behaviour.init(KEY), action[:1], action, step)
    # Each random choice lasts for `hold` steps.
    share = hold * epsilon / (hold * epsilon + 1 - epsilon)
    np.testing.assert_allclose(np.exp(log_density), [np.inf, share / (HIGH - LOW)], rtol=1e-5)


def test_the_noise_of_epsilon_greedy_is_on_the_greedy_action():
    behaviour = exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(epsilon_end=0.2, noise=0.3))
    drawn = (
        np.float32([0.1, 0.5, 0.5, 0.5]),
        np.float32([[2.5]] * 4),
        np.float32([[9, 0, 1, 9]]).T,
    )
    action, log_density = perturb(behaviour, behaviour.init(KEY), 0.5, drawn, 5000)
    np.testing.assert_allclose(action[:, 0], [2.5, 0.5, 1.1, HIGH], rtol=1e-6)
    law = scipy.stats.norm(0.5, 0.6)
    expected = 0.8 * np.append(law.pdf(action[:3, 0]), law.sf(HIGH)) + 0.05 * (action[:, 0] < HIGH)
    np.testing.assert_allclose(np.exp(log_density), expected, rtol=1e-4)


def test_noise_does_not_change_the_choices_or_the_random_actions():
    plain = EPSILON_GREEDY.draw(KEY)
    noisy = exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(noise=0.3)).draw(KEY)
    assert plain[2] is None
    assert (plain[0], plain[1]) == (noisy[0], noisy[1])


def test_with_noise_no_random_action_is_on_a_bound():
    # Floats are so coarse here that one draw in sixteen would be rounded to a bound.
    coarse = SPEC._replace(action_low=np.float32([2**20]), action_high=np.float32([2**20 + 1]))
    behaviour = exploration.epsilon_greedy(coarse, EpsilonGreedyHParams(noise=0.3))
    action = np.asarray(jax.jit(jax.vmap(behaviour.draw))(jax.random.split(KEY, 1000))[1])
    assert action.min() > coarse.action_low
    assert action.max() < coarse.action_high


def test_an_episode_does_not_inherit_a_held_action():
    behaviour = exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(hold=5.0))
    begin, decline = (jnp.float32(0.0), jnp.ones(1), None), (jnp.float32(1.0), jnp.ones(1), None)
    _, _, state = behaviour.perturb(behaviour.init(KEY), jnp.zeros(1), begin, 2500)
    action, _, _ = behaviour.perturb(behaviour.reset(state), jnp.zeros(1), decline, 2500)
    assert action == 0.0


BEHAVIOURS = [
    exploration.gaussian(SPEC, GaussianHParams(scale=2.0)),
    exploration.ornstein_uhlenbeck(SPEC, OrnsteinUhlenbeckHParams(sigma=2.0)),
    exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(hold=2.0)),
    exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(hold=2.0, noise=0.5)),
]
JITTED = [jax.jit(behaviour.sample) for behaviour in BEHAVIOURS]
kinds = pytest.mark.parametrize(
    "kind", range(4), ids=["gaussian", "ou", "epsilon_greedy", "noisy_epsilon_greedy"]
)


@kinds
@given(
    seed=st.integers(0, 2**32 - 1),
    mu=st.floats(float(LOW), float(HIGH), width=32),
    step=st.integers(0, 20_000),
)
def test_actions_stay_in_bounds_with_a_density_infinite_at_an_atom_alone(kind, seed, mu, step):
    state = BEHAVIOURS[kind].init(KEY)
    for key in jax.random.split(jax.random.key(seed), 3):
        action, log_density, state = JITTED[kind](key, state, np.float32([mu]), step)
        action, log_density = np.asarray(action), np.asarray(log_density)
        assert LOW <= action <= HIGH
        assert np.isfinite(log_density) or (kind == 2 and log_density > 0 and action == mu)


@kinds
def test_sample_is_perturb_of_draw(kind):
    behaviour = BEHAVIOURS[kind]

    @jax.jit
    def both(key, state, mu):
        sampled = behaviour.sample(key, state, mu, 100)
        return sampled, behaviour.perturb(state, mu, behaviour.draw(key), 100)

    chex.assert_trees_all_equal(*both(KEY, behaviour.init(KEY), np.float32([0.3])))


def test_hyperparameters_can_be_vmapped_over():
    behaviour = exploration.ornstein_uhlenbeck(SPEC)
    sigmas = np.float32([0.1, 0.2, 0.4])
    state = behaviour.init(KEY)

    @jax.jit
    @jax.vmap
    def perturbed(sigma):
        given = state.replace(hparams=state.hparams.replace(sigma=sigma))
        return behaviour.perturb(given, np.zeros(1, np.float32), np.float32([0.7]), 0)[0]

    action = np.asarray(perturbed(sigmas))
    np.testing.assert_allclose(action[:, 0], 0.7 * HALF_WIDTH * sigmas, rtol=1e-6)


MU, STEP, SHARE = 0.8, 2500, 0.505
"""The greedy action of the estimates of Z, and a step with its epsilon."""


def reward(action):
    return np.sin(2.0 * action) - 0.3 * np.square(action - 0.5)


def integral(*, atoms):
    action, weight = reference.base_measure(SPEC, atoms=atoms)
    return float(weight @ np.exp(reward(action[:, 0])))


INSIDE, WITH_BOUNDS = integral(atoms=False), integral(atoms=True)
HELD = 2 * SHARE / (1 + 2 * SHARE)
"""The share of the steps at which a random action of three steps is being held."""
ESTIMATES = {
    # Its kind, the behaviour, the estimates by its recorded and by its marginal densities.
    "gaussian": (
        0,
        exploration.gaussian(SPEC, GaussianHParams(scale=0.6)),
        WITH_BOUNDS,
        WITH_BOUNDS,
    ),
    "ornstein_uhlenbeck": (
        1,
        exploration.ornstein_uhlenbeck(SPEC, OrnsteinUhlenbeckHParams(theta=0.5, sigma=1.0)),
        WITH_BOUNDS,
        WITH_BOUNDS,
    ),
    "epsilon_greedy": (2, EPSILON_GREEDY, INSIDE, INSIDE),
    "noisy_epsilon_greedy": (
        3,
        exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(noise=0.5)),
        WITH_BOUNDS,
        WITH_BOUNDS,
    ),
    "held_epsilon_greedy": (
        2,
        exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(hold=3.0)),
        INSIDE,
        INSIDE,
    ),
    # A held action is never at a bound, so these steps lack the bounds' share of Z.
    "noisy_held_epsilon_greedy": (
        3,
        exploration.epsilon_greedy(SPEC, EpsilonGreedyHParams(hold=3.0, noise=0.5)),
        HELD * INSIDE + (1 - HELD) * WITH_BOUNDS,
        WITH_BOUNDS,
    ),
}


@functools.cache
def runs(kind):
    """Many runs from a state, which brings its hyperparameters."""
    behaviour = BEHAVIOURS[kind]

    def run(key, state):
        def advance(state, key):
            action, recorded, state = behaviour.sample(key, state, jnp.float32([MU]), STEP)
            return state, (action, recorded)

        state, (action, recorded) = jax.lax.scan(advance, state, jax.random.split(key, 40))
        # By then the noise is stationary.
        marginal = behaviour.log_density(state, jnp.float32([MU]), action[20:], STEP)
        return action[20:, 0], recorded[20:], marginal

    return jax.jit(jax.vmap(run, in_axes=(0, None)))


@pytest.mark.parametrize("name", ESTIMATES)
def test_actions_weighted_by_their_densities_estimate_the_partition_function(name):
    kind, behaviour, *expected = ESTIMATES[name]
    played = runs(kind)(jax.random.split(KEY, 8000), behaviour.init(KEY))
    action, *log_densities = jax.tree.map(np.float64, played)
    for log_density, value in zip(log_densities, expected, strict=True):
        # The steps of one run depend on each other; the runs are independent.
        estimates = np.exp(reward(action) - log_density).mean(axis=1)
        error = estimates.std() / len(estimates) ** 0.5
        assert error < 0.02 * value
        assert abs(estimates.mean() - value) < 4 * error


@kinds
def test_arrays_of_other_shapes_are_refused(kind):
    behaviour = BEHAVIOURS[kind]
    state = behaviour.init(KEY)
    for action in (jnp.zeros((5, 1)), jnp.zeros(2), jnp.zeros(())):
        with pytest.raises(ValueError, match=r"action: expected shape \(1,\), got"):
            behaviour.sample(KEY, state, action, 0)
    with pytest.raises(TypeError, match="action: expected floats, got int32"):
        behaviour.sample(KEY, state, jnp.zeros(1, int), 0)
    with pytest.raises(ValueError, match="noise: expected shape"):
        behaviour.perturb(state, jnp.zeros(1), jnp.zeros((5, 1)), 0)
    with pytest.raises(ValueError, match=r"step: expected shape \(\), got \(5,\)"):
        behaviour.sample(KEY, state, jnp.zeros(1), jnp.arange(5))


@kinds
def test_marginal_densities_read_the_last_axis_and_broadcast_the_leading_ones(kind):
    behaviour = BEHAVIOURS[kind]
    state = behaviour.init(KEY)
    pairs = np.zeros((4, 1, 1), np.float32), np.ones((5, 1), np.float32)
    log_density = jax.eval_shape(behaviour.log_density, state, *pairs, 0)
    assert log_density.shape == (4, 5)
    with pytest.raises(ValueError, match=r"greedy: expected shape \(1,\), got \(5,\)"):
        behaviour.log_density(state, jnp.zeros(5), jnp.zeros(5), 0)
    with pytest.raises(ValueError, match=r"\(5, 1\), \(7, 1\)"):
        behaviour.log_density(state, jnp.zeros((5, 1)), jnp.zeros((7, 1)), 0)
    with pytest.raises(TypeError, match="action: expected floats, got int32"):
        behaviour.log_density(state, jnp.zeros((5, 1)), jnp.zeros((5, 1), int), 0)
