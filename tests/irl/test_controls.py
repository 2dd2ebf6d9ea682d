import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.irl import IRLHParams, controls
from cmedirl_jax.types import Network
from tests.support.agents import SPEC, random_batch

KEY = jax.random.key(0)
OF_ONE = controls.random(SPEC, IRLHParams(bound=1.0))
BOUNDED = controls.random(SPEC, IRLHParams(bound=0.2))
PAIRS = tuple(
    np.random.default_rng(0).uniform(low, high, (5000, len(low))).astype(np.float32)
    for low, high in (
        (SPEC.observation_low, SPEC.observation_high),
        (SPEC.action_low, SPEC.action_high),
    )
)

init = jax.jit(OF_ONE.init)


@jax.jit
def standardised(state, *pairs):
    """The random reward before its bound."""
    return jnp.arctanh(OF_ONE.reward(state, *pairs))


def test_a_constant_is_the_same_everywhere():
    control = controls.constant(-0.3)
    state = control.init(KEY)
    for leading in ((), (4,), (2, 3)):
        reward = control.reward(state, jnp.zeros((*leading, 2)), jnp.ones((*leading, 1)))
        np.testing.assert_array_equal(reward, np.full(leading, -0.3, np.float32))


@pytest.mark.parametrize("seed", range(3))
def test_a_random_reward_has_mean_zero_and_deviation_one_over_other_uniform_pairs(seed):
    output = np.float64(standardised(init(jax.random.key(seed)), *PAIRS))
    # It is standardised over 1024 pairs, so its mean is off by about 1/32.
    assert abs(output.mean()) < 0.15
    assert output.std() == pytest.approx(1.0, abs=0.1)


def test_its_mean_and_deviation_are_those_of_the_network_over_the_bounds(skewed_spec):
    """A network that returns a coordinate has the moments of a uniform law."""
    coordinates = [
        (lambda observation, action: observation[..., 2], 2.0, 10.0),
        (lambda observation, action: action[..., 1], 0.5, 1.0),
    ]
    for coordinate, low, high in coordinates:
        network = Network(
            lambda key: (), lambda params, *inputs, coordinate=coordinate: coordinate(*inputs)
        )
        _, mean, deviation = jax.jit(controls.random(skewed_spec, network=network).init)(KEY).params
        wide = high - low
        np.testing.assert_allclose(mean, 0.5 * (low + high), atol=0.05 * wide)
        np.testing.assert_allclose(deviation, wide / np.sqrt(12), rtol=0.1)


def test_the_bound_squashes_the_standardised_network():
    reward = jax.jit(lambda key: BOUNDED.reward(BOUNDED.init(key), *PAIRS))(KEY)
    np.testing.assert_allclose(reward, 0.2 * np.tanh(standardised(init(KEY), *PAIRS)), atol=1e-5)
    assert np.std(reward) > 0.1


@pytest.mark.parametrize("control", [controls.constant(0.1), OF_ONE], ids=["constant", "random"])
def test_updates_learn_nothing(control):
    before, batch = jax.jit(control.init)(KEY), random_batch(KEY, 5)
    after, info = control.update(before, batch, batch, key=KEY)
    chex.assert_trees_all_equal(after, before)
    assert not np.any(jax.device_get(info))


def test_each_seed_has_its_own_random_reward():
    keys = jax.random.split(KEY, 3)
    states = jax.jit(jax.vmap(OF_ONE.init))(keys)
    together = jax.jit(jax.vmap(OF_ONE.reward, in_axes=(0, None, None)))(states, *PAIRS)
    for index, key in enumerate(keys):
        alone = standardised(init(key), *PAIRS)
        np.testing.assert_allclose(together[index], np.tanh(alone), rtol=1e-3, atol=1e-4)
    correlation = np.corrcoef(together)
    assert np.abs(correlation[np.triu_indices(3, 1)]).max() < 0.99
    constant = controls.constant(0.1)
    np.testing.assert_array_equal(jax.vmap(constant.init)(keys).params, np.float32([0.1] * 3))


def test_observations_without_bounds_are_probed_as_their_statistics_make_them():
    spec = SPEC._replace(observation_low=np.float32([-np.inf, -0.07]))
    learner = controls.random(spec)
    rng = np.random.default_rng(1)
    observation = np.stack([rng.normal(size=4_000), rng.uniform(-0.07, 0.07, 4_000)], axis=1)
    pairs = np.float32(observation), np.float32(rng.uniform(-1.0, 1.0, (4_000, 1)))

    @jax.jit
    def share(key):
        state = learner.init(key)
        return learner.reward(state, *pairs) / state.hparams.bound

    f = np.arctanh(np.asarray(share(KEY)))
    assert abs(f.mean()) < 0.1
    assert f.std() == pytest.approx(1.0, abs=0.1)
