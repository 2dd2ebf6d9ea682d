import jax
import numpy as np
import pytest
import scipy.special
import scipy.stats

from tests.support import reference
from tests.support.agents import scaled
from tests.support.samples import (
    ACTOR,
    DEVIATION,
    PERIOD,
    POOL,
    SNAPSHOTS,
    STEPS,
    WHOLE_DRAWS,
    actor_at,
    numbers,
    run,
    take,
)


def clipped_normal(mean, deviation, action):
    law = scipy.stats.norm(mean, deviation)
    at = [action <= -1.0, action >= 1.0]
    return np.select(at, [law.logcdf(-1.0), law.logsf(1.0)], law.logpdf(action))[..., 0]


def of_demonstrator(state, transition):
    coefficients, deviation = reference.float64(state.weights.demonstrator)
    mean = coefficients[0] + np.float64(transition.observation) @ coefficients[1:]
    return clipped_normal(mean, deviation, np.float64(transition.action))


def of_snapshots(transition, steps):
    """log q_k(a|s) `[K, ...]` of the latest snapshots after so many steps."""
    taken = range(0, steps, PERIOD)[-SNAPSHOTS:]
    observation, action = scaled(transition.observation), np.float64(transition.action)
    greedy = [
        np.tanh(reference.mlp(reference.float64(actor_at(step)), observation)) for step in taken
    ]
    return np.stack([clipped_normal(mean, DEVIATION, action) for mean in greedy])


def mixed(log_densities):
    return scipy.special.logsumexp(log_densities, axis=0) - np.log(len(log_densities))


def half_and_half(first, second):
    return np.logaddexp(first, second) - np.log(2.0)


def assert_close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)


def test_the_demonstrator_is_fitted_to_the_subsets_pairs_alone():
    fitted = run("recorded")[0].weights.demonstrator
    own = np.r_[10:15, 0:6, 21:24]
    pairs = np.c_[np.ones(14), np.float64(POOL.observation[own])]
    slopes, squares, *_ = np.linalg.lstsq(pairs, np.float64(POOL.action[own]))
    # 1024 pairs are drawn with replacement from fourteen, so the fit is approximate.
    mean = np.float64(POOL.observation[own]) @ fitted.coefficients[1:] + fitted.coefficients[0]
    np.testing.assert_allclose(mean, pairs @ slopes, atol=0.15)
    np.testing.assert_allclose(fitted.scale, np.sqrt(squares / 14), rtol=0.1)


@pytest.mark.parametrize("steps", [10, STEPS])
def test_recorded_densities_are_those_of_the_very_rows(steps):
    demonstrations, sampled = take("recorded", steps=steps)
    state, _, _, recorded = run("recorded", steps=steps)
    rows = np.int32(sampled.transition.reward)
    np.testing.assert_array_equal(sampled.log_density, np.float32(recorded)[rows])
    assert len(set(recorded)) > 0.9 * steps
    assert_close(demonstrations.log_density, of_demonstrator(state, demonstrations.transition))


@pytest.mark.parametrize("steps", [0, 1, 7, 8, 21, 22, STEPS])
def test_snapshots_are_the_latest_ones_of_every_period(steps):
    snapshots = run("fusion", steps=steps)[0].weights.snapshots
    taken = range(0, steps, PERIOD)[-SNAPSHOTS:]
    expected = [actor_at(step) for step in taken]
    expected += [jax.tree.map(np.zeros_like, ACTOR)] * (SNAPSHOTS - len(taken))
    kept = [jax.tree.map(lambda leaf, slot=slot: leaf[slot], snapshots) for slot in range(3)]

    def as_sorted(trees):
        rows = [
            np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)]) for tree in trees
        ]
        return np.array(sorted(map(tuple, rows)))

    np.testing.assert_allclose(as_sorted(kept), as_sorted(expected), rtol=1e-6)


@pytest.mark.parametrize("append", [False, True])
@pytest.mark.parametrize("steps", [7, 8, STEPS])
def test_fused_densities_are_the_mixtures_of_a_brute_force(steps, append):
    batches = take("fusion", append=append, steps=steps)
    state = run("fusion", steps=steps)[0]
    for batch in batches:
        expected = mixed(of_snapshots(batch.transition, steps))
        if append:
            expected = half_and_half(expected, of_demonstrator(state, batch.transition))
        assert_close(batch.log_density, expected)
        assert batch.mask.all()


@pytest.mark.parametrize("steps", [8, STEPS])
def test_a_snapshot_explores_as_it_did_when_it_was_taken(steps):
    """Epsilon falls, so each component of the mixture has its own."""
    _, sampled = take("fusion", append=False, steps=steps, behaviour="epsilon-greedy")
    transition = sampled.transition
    action, observation = np.float64(transition.action), scaled(transition.observation)
    inside = np.abs(action[:, 0]) < 1.0
    components = []
    for step in range(0, steps, PERIOD)[-SNAPSHOTS:]:
        epsilon = 0.9 - 0.8 * min(step / 40, 1.0)
        greedy = np.tanh(reference.mlp(reference.float64(actor_at(step)), observation))
        near = np.exp(clipped_normal(greedy, 0.4, action))
        components.append(epsilon * inside / 2.0 + (1.0 - epsilon) * near)
    assert_close(sampled.log_density, np.log(np.mean(components, axis=0)))


def test_uniform_trajectories_weigh_alike():
    for batch in take("uniform", "trajectory", draws=WHOLE_DRAWS):
        np.testing.assert_array_equal(batch.log_density, np.zeros(60))


def summed(log_density, mask):
    return np.where(mask, log_density, 0.0).sum(axis=-1)


def test_a_trajectorys_recorded_density_is_the_sum_over_its_steps():
    demonstrations, sampled = take("recorded", "trajectory", draws=WHOLE_DRAWS)
    state, _, _, recorded = run("recorded", "trajectory")
    expected = [recorded[list(episode)].sum() for episode in numbers(sampled)]
    assert_close(sampled.log_density, expected)
    by_step = of_demonstrator(state, demonstrations.transition)
    assert_close(demonstrations.log_density, summed(by_step, demonstrations.mask))


@pytest.mark.parametrize("append", [False, True])
def test_a_trajectorys_fused_density_is_of_one_policy_from_end_to_end(append):
    batches = take("fusion", "trajectory", append, draws=WHOLE_DRAWS)
    state = run("fusion", "trajectory")[0]
    for batch in batches:
        expected = mixed(summed(of_snapshots(batch.transition, STEPS), batch.mask))
        if append:
            by_step = of_demonstrator(state, batch.transition)
            expected = half_and_half(expected, summed(by_step, batch.mask))
        assert_close(batch.log_density, expected)
