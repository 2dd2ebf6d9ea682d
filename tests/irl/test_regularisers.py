import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from cmedirl_jax.irl import regularisers
from tests.support import reference

KEY = jax.random.key(0)
RNG = np.random.default_rng(0)
VALUES = RNG.normal(size=6).astype(np.float32)
MASK = np.array([True, False, True, True, False, True])
NOTHING = np.zeros(6, bool)
OBSERVATION = RNG.normal(size=(6, 2)).astype(np.float32)
ACTION = RNG.normal(size=(6, 1)).astype(np.float32)
UNITS = np.float32([0.9, 0.07]), np.float32([2.0])
SLOPES = np.float32([0.8, -3.0, 0.5])


def squashed(weight, observation, action):
    """tanh of an affine function, with the gradient (1 - tanh^2) weight."""
    return jnp.tanh(weight @ jnp.concatenate([observation, action]))


@jax.jit
def penalty(weight, mask, target):
    return regularisers.gradient_penalty(
        lambda observation, action: squashed(weight, observation, action),
        OBSERVATION,
        ACTION,
        mask,
        scale=UNITS,
        target=target,
    )


penalty_gradient = jax.jit(jax.grad(penalty))
bounded = jax.jit(regularisers.bounded, static_argnums=2)
slope = jax.jit(jax.vmap(jax.grad(regularisers.bounded), in_axes=(0, None, None)), static_argnums=2)
gauge_offset = jax.jit(regularisers.gauge_offset, static_argnums=0)


def reference_penalty(weight, mask, target):
    steep = 1.0 - np.tanh(np.float64(np.c_[OBSERVATION, ACTION]) @ weight) ** 2
    norm = np.linalg.norm(steep[:, None] * weight * np.concatenate(UNITS), axis=1)
    return np.mean((norm - target)[mask] ** 2)


def test_the_prior_is_a_gaussians_logarithm():
    params = {"kernel": np.float32([[1.0, -2.0], [0.5, 3.0]]), "bias": (np.float32([4.0]), None)}
    law = scipy.stats.norm(0.0, 1.0 / np.sqrt(0.3))
    expected = law.logpdf([1.0, -2.0, 0.5, 3.0, 4.0]).sum() - 5 * law.logpdf(0.0)
    assert regularisers.log_prior(params, 0.3) == pytest.approx(expected, rel=1e-6)


def test_the_output_penalty_is_the_mean_square_of_unmasked_outputs():
    value = regularisers.output_penalty(VALUES, MASK)
    np.testing.assert_allclose(value, np.mean(np.float64(VALUES[MASK]) ** 2), rtol=1e-6)
    spoilt = np.where(MASK, VALUES, np.nan)
    np.testing.assert_array_equal(regularisers.output_penalty(spoilt, MASK), value)
    assert regularisers.output_penalty(VALUES, NOTHING) == 0


@pytest.mark.parametrize("target", [0.0, 0.7])
@pytest.mark.parametrize("mask", [MASK, ~NOTHING])
def test_the_gradient_penalty_and_its_gradient_are_those_of_a_known_function(mask, target):
    value = penalty(SLOPES, mask, target)
    np.testing.assert_allclose(value, reference_penalty(SLOPES, mask, target), rtol=1e-5)
    expected = reference.gradient(lambda weight: reference_penalty(weight, mask, target), SLOPES)
    np.testing.assert_allclose(
        penalty_gradient(SLOPES, mask, target), expected, rtol=1e-4, atol=1e-6
    )


def test_a_flat_function_has_a_penalty_and_a_finite_gradient():
    flat = np.zeros(3, np.float32)
    for target in (0.0, 1.0):
        assert penalty(flat, MASK, target) == target**2
        np.testing.assert_array_equal(penalty_gradient(flat, MASK, target), flat)
    assert penalty(SLOPES, NOTHING, 1.0) == 0
    np.testing.assert_array_equal(penalty_gradient(SLOPES, NOTHING, 1.0), flat)


def test_interpolation_draws_one_uniform_place_for_all_leaves_of_a_pair():
    demonstrations = RNG.normal(size=(3000, 2)), RNG.normal(size=(3000, 1)), RNG.normal(size=3000)
    background = tuple(RNG.normal(size=(2000, *leaf.shape[1:])) for leaf in demonstrations)
    demonstrations, background = jax.tree.map(np.float32, (demonstrations, background))
    points = regularisers.interpolate(KEY, demonstrations, background)
    ends = [
        np.column_stack([leaf[:2000] for leaf in batch]) for batch in (demonstrations, background)
    ]
    way = np.float64(ends[0]) - ends[1]
    share = np.sum((np.column_stack(points) - ends[1]) * way, axis=1) / np.sum(way**2, axis=1)
    np.testing.assert_allclose(np.column_stack(points), ends[1] + share[:, None] * way, atol=1e-5)
    assert scipy.stats.kstest(share, "uniform").pvalue > 1e-3
    again = regularisers.interpolate(jax.random.key(1), background, demonstrations)
    assert [leaf.shape for leaf in again] == [leaf.shape for leaf in background]
    assert not np.array_equal(again[2], points[2])


OUTPUTS = np.float32([-1e4, -3.0, -0.2, -0.05, 0.0, 0.05, 0.2, 3.0, 1e4])


def test_bounds_and_their_derivatives():
    exact = np.float64(OUTPUTS)
    inside = np.abs(exact) < 0.1
    expected = {
        "tanh": (0.1 * np.tanh(exact), 0.1 * (1 - np.tanh(exact) ** 2)),
        "clip": (np.where(inside, exact, 0.1 * np.sign(exact)), inside),
        "none": (exact, np.ones(len(exact))),
    }
    for kind, (value, derivative) in expected.items():
        np.testing.assert_allclose(bounded(OUTPUTS, 0.1, kind), value, rtol=1e-6)
        np.testing.assert_allclose(slope(OUTPUTS, 0.1, kind), derivative, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("kind", ["tanh", "clip"])
def test_no_output_leaves_the_bounds(kind):
    bound = np.float32(0.1)
    assert np.abs(bounded(OUTPUTS, bound, kind)).max() <= bound


def test_gauges_ignore_masked_entries():
    demonstrated, sampled = (VALUES, MASK), (2.0 * VALUES + 1.0, ~MASK)
    assert gauge_offset("none", demonstrated, sampled) == 0
    offset = gauge_offset("zero-mean", demonstrated, sampled)
    np.testing.assert_allclose(offset, np.mean(np.float64(sampled[0][~MASK])), rtol=1e-6)
    lowered = np.where(MASK, VALUES, 100.0), MASK
    assert gauge_offset("demonstration-maximum", lowered, sampled) == VALUES[MASK].max()
    below_zero = VALUES - 10.0, MASK
    offset = gauge_offset("demonstration-maximum", below_zero, sampled)
    assert offset == (VALUES - np.float32(10.0))[MASK].max()


@pytest.mark.parametrize("kind", ["none", "zero-mean", "demonstration-maximum"])
def test_without_samples_a_gauge_is_zero(kind):
    assert gauge_offset(kind, (VALUES, NOTHING), (VALUES, NOTHING)) == 0


def test_the_absorbing_state_earns_its_reward_for_ever():
    for_ever = sum(0.95**step * -0.3 for step in range(1, 2000))
    terminated = np.array([False, True, False, True])
    reward = regularisers.absorbed_reward(jnp.float32(-0.3), terminated, 0.95)
    np.testing.assert_allclose(reward, np.where(terminated, for_ever, 0.0), rtol=1e-5)


def test_a_masked_mean_ignores_masked_entries():
    grid, mask = VALUES.reshape(2, 3), MASK.reshape(2, 3)
    mean = regularisers.masked_mean(grid, mask)
    np.testing.assert_allclose(mean, np.mean(np.float64(grid[mask])), rtol=1e-6)
    assert regularisers.masked_mean(grid, np.zeros_like(mask)) == 0
