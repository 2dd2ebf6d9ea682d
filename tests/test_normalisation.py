import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from cmedirl_jax import networks, normalisation, observation_statistics
from cmedirl_jax.agents import ddpg
from cmedirl_jax.irl import regularisers, rewards
from cmedirl_jax.networks import Architecture
from cmedirl_jax.observation_statistics import STATISTICS, Statistics
from cmedirl_jax.types import Transition

KEY = jax.random.key(0)
begin_statistics = jax.jit(observation_statistics.begin)
add_to_statistics = jax.jit(observation_statistics.add)
of_running = jax.jit(observation_statistics.of_running)
of_sample = jax.jit(observation_statistics.of_sample)


@pytest.fixture
def unbounded(skewed_spec):
    """The first observation has sensible bounds, the others have none."""
    return skewed_spec._replace(
        observation_low=np.array([skewed_spec.observation_low[0], -np.inf, -3.4e38], np.float32),
        observation_high=np.array([skewed_spec.observation_high[0], 1e30, 3.4e38], np.float32),
    )


def test_bounds_map_to_one_and_need_no_statistics(skewed_spec):
    made = normalisation.make(skewed_spec, "bounds")
    low, high = skewed_spec.observation_low, skewed_spec.observation_high
    assert made.initial() == {}
    for scale in (lambda observation: made({}, observation), normalisation.by_bounds(skewed_spec)):
        np.testing.assert_allclose(scale(low), [-1, -1, -1], rtol=1e-6)
        np.testing.assert_allclose(scale(high), [1, 1, 1], rtol=1e-6)
        np.testing.assert_allclose(scale((low + high) / 2), [0, 0, 0], atol=1e-6)


def test_senseless_bounds_give_way_to_statistics_one_by_one(unbounded):
    made = normalisation.make(unbounded, "bounds")
    np.testing.assert_array_equal(made.by_statistics, [False, True, True])
    variables = {
        STATISTICS: {"mean": jnp.array([9.0, 1.0, -2.0]), "std": jnp.array([9.0, 2.0, 4.0])}
    }
    high = unbounded.observation_high[0]
    found = made(variables, jnp.array([high, 5.0, -10.0]))
    np.testing.assert_allclose(found, [1.0, 2.0, -2.0], rtol=1e-6)
    # Far out it is clipped.
    assert made(variables, jnp.array([high, 1e9, 0.0]))[1] == normalisation.CLIP


def test_statistics_everywhere_or_nothing_at_all(skewed_spec):
    everywhere = normalisation.make(skewed_spec, "statistics")
    assert everywhere.by_statistics.all()
    nothing = normalisation.make(skewed_spec, "none")
    observation = jnp.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(nothing({}, observation), observation)


def test_features_over_the_bounds_refuse_senseless_ones(unbounded):
    for features in (
        lambda: rewards.radial_basis(unbounded, 3),
        lambda: rewards.fourier(unbounded, 2),
    ):
        with pytest.raises(ValueError, match=r"Skewed-v0.*finite bounds"):
            features()


@given(npst.arrays(np.float32, (7, 2), elements=st.floats(-100, 100, width=32)))
def test_running_statistics_are_those_of_all_observations(observations):
    running = begin_statistics(observations[0])
    assert of_running(running).std.tolist() == [1.0, 1.0]
    for observation in observations[1:]:
        running = add_to_statistics(running, observation)
    found = jax.device_get(of_running(running))
    mean, std = (
        observations.mean(axis=0, dtype=np.float64),
        observations.std(axis=0, dtype=np.float64),
    )
    np.testing.assert_allclose(found.mean, mean, rtol=1e-4, atol=1e-3)
    spread = std > 0.02 * np.maximum(np.abs(mean), 1.0)
    np.testing.assert_allclose(found.std[spread], std[spread], rtol=1e-2)
    together = jax.device_get(of_sample(observations))
    np.testing.assert_allclose(together.std[spread], std[spread], rtol=1e-2)


def test_a_constant_observation_is_not_divided_by_its_rounding():
    observations = jnp.full((100, 2), 0.1) + jnp.array([0.0, 1e7])
    np.testing.assert_array_equal(observation_statistics.of_sample(observations).std, [1.0, 1.0])


def test_statistics_are_put_into_every_network_of_a_tree(unbounded):
    actor = networks.make(unbounded).actor.init(KEY)
    tree = {"a": actor, "b": (actor, jnp.zeros(3))}
    assert observation_statistics.kept(tree)
    assert not observation_statistics.kept({"params": jnp.zeros(2)})
    put = observation_statistics.put(tree, Statistics(jnp.arange(3.0), jnp.full(3, 2.0)))
    for one in (put["a"], put["b"][0]):
        np.testing.assert_array_equal(one[STATISTICS]["mean"], [0, 1, 2])
        np.testing.assert_array_equal(one[STATISTICS]["std"], [2, 2, 2])
        chex.assert_trees_all_equal(one["params"], actor["params"])


def batch(spec, size=5):
    rng = np.random.default_rng(0)
    observation, following = rng.normal(size=(2, size, spec.observation_dim)).astype(np.float32)
    action = rng.uniform(spec.action_low, spec.action_high, (size, spec.action_dim))
    done = np.zeros(size, bool)
    return Transition(
        observation, action.astype(np.float32), np.ones(size, np.float32), following, done
    )


def test_no_gradient_and_no_weight_decay_reach_the_statistics(unbounded):
    agent = ddpg.make(
        unbounded, actor_optimizer=optax.adamw(0.1), critic_optimizer=optax.adamw(0.1)
    )
    statistics = Statistics(np.arange(1.0, 4.0, dtype=np.float32), np.full(3, 2.0, np.float32))

    @jax.jit
    def begin(key):
        params = tuple(network.init(key) for network in agent.networks[:2])
        return agent.init(key, observation_statistics.put(params, statistics))

    state = begin(KEY)
    after, _ = jax.device_get(jax.jit(agent.update)(state, batch(unbounded)))
    for name in ("actor", "critic", "target_actor", "target_critic"):
        kept = getattr(after, name)[STATISTICS]
        np.testing.assert_allclose(kept["mean"], statistics.mean, rtol=1e-6)
        np.testing.assert_allclose(kept["std"], statistics.std, rtol=1e-6)
    assert not np.allclose(
        after.actor["params"]["Dense_0"]["bias"], state.actor["params"]["Dense_0"]["bias"]
    )


def test_a_prior_is_of_weights_alone(unbounded):
    params = jax.jit(rewards.mlp(unbounded, (4,)).init)(KEY)
    moved = observation_statistics.put(params, Statistics(jnp.full(3, 50.0), jnp.full(3, 70.0)))
    assert regularisers.log_prior(params, 2.0) == regularisers.log_prior(moved, 2.0)
    expected = -sum(np.sum(np.square(x)) for x in jax.tree.leaves(params["params"]))
    assert float(regularisers.log_prior(moved, 2.0)) == pytest.approx(expected, rel=1e-5)


def test_networks_with_statistics_read_what_was_put(unbounded):
    made = networks.make(unbounded, Architecture(normalise_observation="statistics"))
    actor = made.actor.init(KEY)
    observation = jnp.array([0.3, -2.0, 8.0])
    statistics = Statistics(jnp.array([0.1, 2.0, -3.0]), jnp.array([2.0, 4.0, 5.0]))
    expected = made.actor.apply(actor, (observation - statistics.mean) / statistics.std)
    found = made.actor.apply(observation_statistics.put(actor, statistics), observation)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_the_unit_of_an_observation_is_its_range_or_its_deviation(unbounded, skewed_spec):
    params = networks.make(unbounded).actor.init(KEY)
    params = observation_statistics.put(
        params, Statistics(jnp.zeros(3), jnp.array([7.0, 2.0, 4.0]))
    )
    width = 0.5 * (skewed_spec.observation_high - skewed_spec.observation_low)
    np.testing.assert_allclose(normalisation.units(unbounded, params), [width[0], 2.0, 4.0])
    np.testing.assert_allclose(normalisation.units(skewed_spec, {}), width)


@pytest.mark.parametrize("kind", [True, False, "mean"])
def test_another_kind_of_normalisation_is_refused(skewed_spec, kind):
    with pytest.raises(ValueError, match="is one of bounds, statistics, none, got"):
        normalisation.make(skewed_spec, kind)
