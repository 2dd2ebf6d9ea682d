import chex
import jax
import numpy as np
import pytest
import scipy.stats

from cmedirl_jax import networks
from cmedirl_jax.networks import Architecture

KEY = jax.random.key(0)
NORMALISATIONS = ["none", "layer", "batch"]
normalisations = pytest.mark.parametrize("normalisation", NORMALISATIONS)


def randomised(network):
    """Random variables; running variances are positive, and no entry is zero or one."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(network.init, KEY)
    variables = jax.tree.map(lambda leaf: rng.normal(0.1, 0.7, leaf.shape), shapes)
    for statistics in variables.get("batch_stats", {}).values():
        statistics["var"] = np.exp(statistics["var"])
    return jax.tree.map(np.float32, variables)


def reference(variables, x, joined=None, *, normalisation, join=0, train=False):
    """The perceptron in float64, and its running statistics after a training step."""
    params, moved = variables["params"], {}
    depth = sum(name.startswith("Dense") for name in params) - 1
    for index in range(depth):
        if joined is not None and index == join:
            x = np.concatenate([x, joined], axis=-1)
        x = x @ params[f"Dense_{index}"]["kernel"] + params[f"Dense_{index}"]["bias"]
        if normalisation == "layer":
            mean, variance = x.mean(-1, keepdims=True), x.var(-1, keepdims=True)
            x = (x - mean) / np.sqrt(variance + 1e-5)
        elif normalisation == "batch":
            name = f"BatchNorm_{index}"
            running = variables["batch_stats"][name]
            mean, variance = running["mean"], running["var"]
            if train:
                mean, variance = x.mean(0), x.var(0)
                moved[name] = {
                    "mean": 0.99 * running["mean"] + 0.01 * mean,
                    "var": 0.99 * running["var"] + 0.01 * variance,
                }
            x = (x - mean) / np.sqrt(variance + 1e-5) * params[name]["scale"] + params[name]["bias"]
        x = np.maximum(x, 0.0)
    return x @ params[f"Dense_{depth}"]["kernel"] + params[f"Dense_{depth}"]["bias"], moved


def inputs(spec, *leading):
    rng = np.random.default_rng(1)
    observation = rng.uniform(
        spec.observation_low, spec.observation_high, (*leading, spec.observation_dim)
    )
    action = rng.uniform(spec.action_low, spec.action_high, (*leading, spec.action_dim))
    return observation.astype(np.float32), action.astype(np.float32)


def scaled(spec, observation):
    low, high = np.float64(spec.observation_low), np.float64(spec.observation_high)
    return 2 * (observation - low) / (high - low) - 1


def float64(tree):
    return jax.tree.map(np.float64, tree)


@normalisations
@pytest.mark.parametrize("normalise_observation", ["bounds", "none"])
def test_actor_is_the_perceptron(skewed_spec, normalisation, normalise_observation):
    architecture = Architecture(
        hidden=(8, 6),
        actor_normalisation=normalisation,
        normalise_observation=normalise_observation,
    )
    actor = networks.make(skewed_spec, architecture).actor
    variables = randomised(actor)
    observation, _ = inputs(skewed_spec, 5)
    x = scaled(skewed_spec, observation) if normalise_observation == "bounds" else observation
    expected, _ = reference(float64(variables), x, normalisation=normalisation)
    output = jax.jit(actor.apply)(variables, observation)
    assert output.shape == (5, skewed_spec.action_dim)
    np.testing.assert_allclose(output, expected, rtol=1e-4, atol=1e-4)


@normalisations
@pytest.mark.parametrize("action_layer", [0, 1])
def test_critic_is_the_perceptron(skewed_spec, normalisation, action_layer):
    architecture = Architecture(
        hidden=(8, 6), critic_normalisation=normalisation, action_layer=action_layer
    )
    critic = networks.make(skewed_spec, architecture).critic
    variables = randomised(critic)
    observation, action = inputs(skewed_spec, 5)
    expected, _ = reference(
        float64(variables),
        scaled(skewed_spec, observation),
        action,
        normalisation=normalisation,
        join=action_layer,
    )
    output = jax.jit(critic.apply)(variables, observation, action)
    assert output.shape == (5,)
    np.testing.assert_allclose(output, expected[..., 0], rtol=1e-4, atol=1e-4)


def test_layer_normalisation_adds_1e_5_to_the_variance(skewed_spec):
    critic = networks.make(skewed_spec, Architecture(hidden=(8,))).critic
    variables = jax.tree.map(lambda leaf: 0.003 * leaf, randomised(critic))
    observation, action = inputs(skewed_spec, 5)
    x = scaled(skewed_spec, observation)
    expected, _ = reference(float64(variables), x, action, normalisation="layer")
    output = jax.jit(critic.apply)(variables, observation, action)
    np.testing.assert_allclose(output, expected[:, 0], rtol=1e-3)


@normalisations
def test_leading_axes_are_mapped_over(skewed_spec, normalisation):
    architecture = Architecture(hidden=(8,), critic_normalisation=normalisation)
    critic = networks.make(skewed_spec, architecture).critic
    variables = randomised(critic)
    observation, action = inputs(skewed_spec, 2, 3)
    apply = jax.jit(critic.apply)
    output = np.asarray(apply(variables, observation, action))
    assert output.shape == (2, 3)
    for index in np.ndindex(2, 3):
        single = apply(variables, observation[index], action[index])
        np.testing.assert_allclose(output[index], single, rtol=1e-5)


def test_training_normalises_by_the_batch_and_moves_the_running_statistics(skewed_spec):
    architecture = Architecture(hidden=(8, 6), critic_normalisation="batch", action_layer=1)
    critic = networks.make(skewed_spec, architecture).critic
    variables = randomised(critic)
    observation, action = inputs(skewed_spec, 32)
    output, moved = jax.jit(critic.train)(variables, observation, action)
    expected, expected_moved = reference(
        float64(variables),
        scaled(skewed_spec, observation),
        action,
        normalisation="batch",
        join=1,
        train=True,
    )
    np.testing.assert_allclose(output, expected[:, 0], rtol=1e-4, atol=1e-4)
    assert set(moved) == {"params", "batch_stats"}
    chex.assert_trees_all_equal(moved["params"], variables["params"])
    chex.assert_trees_all_close(moved["batch_stats"], expected_moved, rtol=1e-4, atol=1e-6)


@normalisations
def test_only_batch_normalisation_has_statistics_to_train(skewed_spec, normalisation):
    architecture = Architecture(
        hidden=(4,), actor_normalisation=normalisation, critic_normalisation=normalisation
    )
    for network in networks.make(skewed_spec, architecture)[:2]:
        assert (network.train is not None) == (normalisation == "batch")


def test_train_mode_of_a_network_without_statistics_is_apply(skewed_spec):
    critic = networks.make(skewed_spec).critic

    @jax.jit
    def both(params, *batch):
        output, same = networks.train_mode(critic)(params, *batch)
        assert same is params
        return output, critic.apply(params, *batch)

    np.testing.assert_array_equal(*both(randomised(critic), *inputs(skewed_spec, 4)))


@pytest.mark.parametrize(("hidden", "action_layer"), [((), 0), ((8,), 0), ((8, 6), 1)])
def test_critic_depends_on_the_action(skewed_spec, hidden, action_layer):
    architecture = Architecture(hidden=hidden, action_layer=action_layer)
    critic = networks.make(skewed_spec, architecture).critic
    variables = randomised(critic)
    observation, action = inputs(skewed_spec, 4)
    apply = jax.jit(critic.apply)
    before, after = (apply(variables, observation, action + by) for by in np.float32([0.0, 0.1]))
    assert np.all(np.asarray(before) != np.asarray(after))


def test_initial_weights_are_uniform_in_their_ranges(skewed_spec):
    architecture = Architecture(hidden=(200, 100), action_layer=1)
    observation_dim, action_dim = skewed_spec.observation_dim, skewed_spec.action_dim
    both = networks.make(skewed_spec, architecture)
    for network, fan_in in (
        (both.actor, (observation_dim, 200)),
        (both.critic, (observation_dim, 200 + action_dim)),
    ):
        layers = jax.device_get(jax.jit(network.init)(KEY)["params"])
        bounds = [1 / np.sqrt(fan_in[0]), 1 / np.sqrt(fan_in[1]), 3e-3]
        for index, bound in enumerate(bounds):
            layer = layers[f"Dense_{index}"]
            weights = np.concatenate([layer["kernel"].ravel(), layer["bias"]])
            assert np.abs(layer["bias"]).max() <= bound
            law = ("uniform", (-bound, 2 * bound))
            assert scipy.stats.kstest(weights, *law).pvalue > 1e-3


def test_output_scale_is_the_range_of_the_last_layer(skewed_spec):
    architecture = Architecture(hidden=(400,), output_scale=0.1)
    init = jax.jit(networks.make(skewed_spec, architecture).critic.init)
    kernel = np.asarray(init(KEY)["params"]["Dense_1"]["kernel"])
    assert 0.09 < np.abs(kernel).max() <= 0.1


def test_squashing_reaches_the_action_bounds(skewed_spec):
    squash = networks.make(skewed_spec).squash
    low, high = skewed_spec.action_low, skewed_spec.action_high
    np.testing.assert_array_equal(squash(np.full(2, -20.0, np.float32)), low)
    np.testing.assert_array_equal(squash(np.full(2, 20.0, np.float32)), high)
    x = np.float32([0.0, 0.5])
    np.testing.assert_allclose(squash(x), (low + high) / 2 + (high - low) / 2 * np.tanh(x))


@pytest.mark.parametrize(
    ("action_layer", "must"), [(-1, "at least 0, got -1"), (3, "between 0 and 2, .*, got 3")]
)
def test_the_action_must_join_at_a_layer(skewed_spec, action_layer, must):
    with pytest.raises(ValueError, match=f"action_layer must be {must}"):
        networks.make(skewed_spec, Architecture(hidden=(8, 6), action_layer=action_layer))
