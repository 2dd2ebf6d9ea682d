import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import rewards


@pytest.mark.parametrize("bound", [0.0, 0.1, 3.0])
def test_bounded_is_a_scaled_tanh(bound):
    x = np.linspace(-4, 4, 9, dtype=np.float32)
    np.testing.assert_allclose(rewards.bounded(x, bound), bound * np.tanh(x), rtol=1e-6)


def test_an_infinite_bound_leaves_the_output_as_it_is():
    x = np.linspace(-40, 40, 9, dtype=np.float32)
    np.testing.assert_array_equal(rewards.bounded(x, jnp.inf), x)


@pytest.mark.parametrize(("bound", "slopes"), [(0.5, (0.5, 0.0)), (np.inf, (1.0, 0.0))])
def test_gradients_are_finite_whatever_the_bound(bound, slopes):
    by_output, by_bound = jax.grad(rewards.bounded, argnums=(0, 1))(0.0, bound)
    assert (by_output, by_bound) == slopes


def test_bounds_can_be_vmapped_over():
    bounds = jnp.array([0.1, 1.0, jnp.inf])
    actual = jax.vmap(rewards.bounded, in_axes=(None, 0))(2.0, bounds)
    np.testing.assert_allclose(actual, [0.1 * np.tanh(2), np.tanh(2), 2.0], rtol=1e-6)


def test_mlp_is_an_unnormalised_perceptron_of_both_inputs(spec):
    network = rewards.mlp(spec, hidden=(8, 6))
    params = network.init(jax.random.key(0))
    rng = np.random.default_rng(0)
    low, high = spec.observation_low, spec.observation_high
    observation = rng.uniform(low, high, (5, 2)).astype(np.float32)
    action = rng.uniform(-1, 1, (5, 1)).astype(np.float32)

    x = np.concatenate([2 * (observation - low) / (high - low) - 1, action], axis=-1)
    layers = [params["params"][f"Dense_{index}"] for index in range(3)]
    for layer in layers[:-1]:
        x = np.maximum(x @ np.float64(layer["kernel"]) + layer["bias"], 0)
    expected = (x @ np.float64(layers[-1]["kernel"]) + layers[-1]["bias"])[:, 0]
    np.testing.assert_allclose(network.apply(params, observation, action), expected, rtol=1e-4)


def test_radial_basis_functions_share_one_and_vary_by_the_action(spec):
    features = rewards.radial_basis(spec, 4)
    observation = np.array([[-1.2, -0.07], [-0.3, 0.0], [0.6, 0.07]], np.float32)
    action = np.array([[0.5], [-1.0], [0.0]], np.float32)
    found = np.asarray(features(observation, action)).reshape(3, 16, 3)
    of_action = np.hstack([np.ones((3, 1)), action, action**2])
    np.testing.assert_allclose(found.sum(axis=1), of_action, rtol=1e-5)
    # The centres run over the bounds, the last dimension fastest.
    assert found[0, :, 0].argmax() == 0
    assert found[2, :, 0].argmax() == 15
    distance = np.array([[x, y] for x in range(4) for y in range(4)]) - 1.5
    weight = np.exp(-0.5 * np.square(distance).sum(axis=1))
    np.testing.assert_allclose(found[1, :, 0], weight / weight.sum(), rtol=1e-4)
    with pytest.raises(ValueError, match="two centres or more, got 1"):
        rewards.radial_basis(spec, 1)
