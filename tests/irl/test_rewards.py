import itertools

import jax
import numpy as np
import pytest

from cmedirl_jax.irl import rewards
from tests.support import reference


def pairs(spec):
    """Five observations and actions within the bounds."""
    rng = np.random.default_rng(0)
    return (
        rng.uniform(low, high, (5, len(low))).astype(np.float32)
        for low, high in (
            (spec.observation_low, spec.observation_high),
            (spec.action_low, spec.action_high),
        )
    )


def test_mlp_is_an_unnormalised_perceptron_of_both_inputs(spec):
    network = rewards.mlp(spec, hidden=(8, 6))
    params = jax.device_get(jax.jit(network.init)(jax.random.key(0)))
    low, high = spec.observation_low, spec.observation_high
    observation, action = pairs(spec)

    x = np.concatenate([2 * (observation - low) / (high - low) - 1, action], axis=-1)
    layers = [params["params"][f"Dense_{index}"] for index in range(3)]
    for layer in layers[:-1]:
        x = np.maximum(x @ np.float64(layer["kernel"]) + layer["bias"], 0)
    expected = (x @ np.float64(layers[-1]["kernel"]) + layers[-1]["bias"])[:, 0]
    output = jax.jit(network.apply)(params, observation, action)
    np.testing.assert_allclose(output, expected, rtol=1e-4)


def test_mlp_of_states_is_a_perceptron_of_the_observation(skewed_spec):
    network = rewards.mlp(skewed_spec, hidden=(8, 6), inputs="state")
    params = jax.device_get(jax.jit(network.init)(jax.random.key(0)))
    observation, action = pairs(skewed_spec)
    low, high = skewed_spec.observation_low, skewed_spec.observation_high
    scaled = 2 * (np.float64(observation) - low) / (high - low) - 1
    expected = reference.mlp(reference.float64(params), scaled)[:, 0]
    output = jax.jit(network.apply)(params, observation, action)
    np.testing.assert_allclose(output, expected, rtol=1e-4)


def test_radial_basis_functions_share_one_and_vary_by_the_action(spec):
    features = jax.jit(rewards.radial_basis(spec, 4))
    observation = np.array([[-1.2, -0.07], [-0.3, 0.0], [0.6, 0.07]], np.float32)
    action = np.array([[0.5], [-1.0], [0.0]], np.float32)
    values = np.asarray(features(observation, action)).reshape(3, 16, 3)
    of_action = np.hstack([np.ones((3, 1)), action, action**2])
    np.testing.assert_allclose(values.sum(axis=1), of_action, rtol=1e-5)
    # The centres run over the bounds, the last dimension fastest.
    assert values[0, :, 0].argmax() == 0
    assert values[2, :, 0].argmax() == 15
    distance = np.array([[x, y] for x in range(4) for y in range(4)]) - 1.5
    weight = np.exp(-0.5 * np.square(distance).sum(axis=1))
    np.testing.assert_allclose(values[1, :, 0], weight / weight.sum(), rtol=1e-4)


def test_radial_basis_functions_of_states_ignore_the_action(skewed_spec):
    observation, action = pairs(skewed_spec)
    both, of_state = (
        np.asarray(jax.jit(rewards.radial_basis(skewed_spec, 3, inputs))(observation, action))
        for inputs in ("state-action", "state")
    )
    np.testing.assert_array_equal(of_state, both.reshape(5, 27, 5)[..., 0])


@pytest.mark.parametrize("inputs", ["state-action", "state"])
def test_fourier_is_konidariss_basis(skewed_spec, inputs):
    observation, action = pairs(skewed_spec)
    low, high = skewed_spec.observation_low, skewed_spec.observation_high
    x = (np.float64(observation) - low) / (high - low)
    if inputs == "state-action":
        x = np.hstack([x, (np.float64(action) - [-1.0, 0.5]) / [4.0, 0.5]])
    expected = [
        [np.cos(np.pi * np.dot(c, row)) for c in itertools.product(range(3), repeat=len(row))]
        for row in x
    ]
    features = jax.jit(rewards.fourier(skewed_spec, 2, inputs))(observation, action)
    np.testing.assert_allclose(features, expected, atol=1e-5)


@pytest.mark.parametrize("inputs", ["state-action", "state"])
@pytest.mark.parametrize("features", [rewards.radial_basis, rewards.fourier])
def test_a_linear_reward_is_theta_times_the_features(skewed_spec, features, inputs):
    phi = features(skewed_spec, 2, inputs)
    network = rewards.linear(skewed_spec, phi)
    observation, action = pairs(skewed_spec)
    values = np.float64(jax.jit(phi)(observation, action))
    np.testing.assert_array_equal(network.init(jax.random.key(0)), np.zeros(values.shape[-1]))
    theta = np.random.default_rng(1).normal(size=values.shape[-1])
    reward = jax.jit(network.apply)(np.float32(theta), observation, action)
    np.testing.assert_allclose(reward, values @ theta, rtol=1e-4, atol=1e-4)


def test_features_need_resolution_and_finite_bounds(spec):
    with pytest.raises(ValueError, match="two centres or more, got 1"):
        rewards.radial_basis(spec, 1)
    with pytest.raises(ValueError, match="order of one or more, got 0"):
        rewards.fourier(spec, 0)
    endless = spec._replace(observation_high=np.float32([np.inf, 1.0]))
    for make in (rewards.fourier, rewards.radial_basis):
        with pytest.raises(ValueError, match="finite bounds"):
            make(endless, 3, "state")
    # A perceptron takes statistics in their place.
    network = rewards.mlp(endless, (3,), "state")
    params = jax.eval_shape(network.init, jax.random.key(0))
    assert jax.eval_shape(network.apply, params, np.ones(2), np.ones(1)).shape == ()


def test_features_that_are_a_power_are_refused_before_they_are_made(spec):
    wide = spec._replace(
        observation_dim=8,
        observation_low=np.full(8, -1.0, np.float32),
        observation_high=np.full(8, 1.0, np.float32),
    )
    with pytest.raises(ValueError, match=r"would be 3\.44e\+8 numbers .* take fewer centres"):
        rewards.radial_basis(wide, 9, "state")
    with pytest.raises(ValueError, match=r"would be 8\.00e\+8 numbers .* take a lower order"):
        rewards.fourier(wide, 9, "state")
    # One pair has 3 x 9 x 9 or 4 x 4 x 4 features: a batch may have too many.
    batch = [jax.ShapeDtypeStruct((2**22, dim), np.float32) for dim in (2, 1)]
    with pytest.raises(ValueError, match=r"would be 1\.02e\+9 numbers"):
        jax.eval_shape(rewards.radial_basis(spec, 9), *batch)
    fourier = rewards.fourier(spec, 3)
    assert jax.eval_shape(fourier, *batch).shape == (2**22, 64)
    with pytest.raises(ValueError, match=r"would be 5\.24e\+8 numbers"):
        jax.eval_shape(rewards.fourier(spec, 4), *batch)


@pytest.mark.parametrize("inputs", ["state-action", "state"])
@pytest.mark.parametrize("make", [rewards.radial_basis, rewards.fourier])
def test_features_refuse_other_sizes_and_leading_axes(skewed_spec, make, inputs):
    features = make(skewed_spec, 2, inputs)
    observation, action = pairs(skewed_spec)
    wrong = [(observation[:, :1], action), (observation.astype(int), action)]
    if inputs == "state-action":
        wrong += [(observation, action[0]), (observation[:4], action), (observation[:, :2], action)]
    for given in wrong:
        with pytest.raises((ValueError, TypeError), match="expected"):
            features(*given)
    if inputs == "state":
        assert jax.eval_shape(features, observation, None).shape[0] == 5


@pytest.mark.parametrize("inputs", ["state-action", "state"])
def test_mlp_does_not_broadcast_an_observation(skewed_spec, inputs):
    network = rewards.mlp(skewed_spec, hidden=(8,), inputs=inputs)
    observation, action = pairs(skewed_spec)
    with pytest.raises(ValueError, match=r"expected the same leading axes .*\(5, 1\)"):
        network.apply(jax.jit(network.init)(jax.random.key(0)), observation[:, :1], action)
