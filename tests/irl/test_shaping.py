import jax
import numpy as np
import pytest

from cmedirl_jax.irl import shaping
from tests.support import mdps

R_E, R_D = np.float32([-0.1, 100.0, 0.0]), np.float32([0.1, -0.05, 0.02])


def test_additive_is_the_sum():
    np.testing.assert_allclose(shaping.additive(R_E, R_D), R_E + R_D)


@pytest.mark.parametrize("weight", [0.0, 0.5, 2.0])
def test_the_weight_scales_the_learned_reward(weight):
    shaped = jax.jit(shaping.additive)(R_E, R_D, weight)
    np.testing.assert_allclose(shaped, R_E + weight * R_D, rtol=1e-6)


def decision_process(seed):
    """`(dynamics, reward, absorbing, Phi)`, the last state absorbing."""
    dynamics, reward, _, absorbing = mdps.random_mdp(seed, states=6, absorbing=True)
    return dynamics, reward, absorbing, 3.0 * np.random.default_rng(seed).normal(size=6)


def optimal_q(dynamics, reward, absorbing, discount=0.9):
    """Hard value iteration on rewards `[S, A, S]` of transitions; absorbing states have value 0."""
    q = np.zeros(reward.shape[:2])
    for _ in range(400):
        after = np.where(absorbing, 0.0, q.max(axis=1))
        q = np.sum(dynamics * (reward + discount * after), axis=2)
    return q


def shaped(reward, potential, terminated, weight=1.0):
    with jax.enable_x64(True):
        arrays = np.broadcast_arrays(
            reward[:, :, None], potential[:, None, None], potential, terminated
        )
        return np.asarray(shaping.potential(*arrays, 0.9, weight))


@pytest.mark.parametrize("weight", [1.0, 0.3])
@pytest.mark.parametrize("seed", range(5))
def test_a_potential_keeps_the_optimal_policy_and_lowers_q_by_itself(seed, weight):
    dynamics, reward, absorbing, potential = decision_process(seed)
    before = optimal_q(dynamics, np.repeat(reward[:, :, None], 6, axis=2), absorbing)
    after = optimal_q(dynamics, shaped(reward, potential, absorbing, weight), absorbing)
    runs = ~absorbing
    expected = before - weight * potential[:, None]
    np.testing.assert_allclose(after[runs], expected[runs], rtol=1e-10)
    assert (before.argmax(axis=1) == after.argmax(axis=1))[runs].all()


def test_a_potential_after_termination_would_change_the_optimal_policy():
    dynamics, reward, absorbing, potential = decision_process(0)
    potential[-1] = 10.0
    zeroed, kept = (
        optimal_q(dynamics, shaped(reward, potential, ends), absorbing).argmax(axis=1)[:-1]
        for ends in (absorbing, np.zeros_like(absorbing))
    )
    assert np.any(zeroed != kept)


def test_a_truncation_keeps_its_potential():
    before, after = np.float32([0.5, 0.5]), np.float32([2.0, 2.0])
    reward = shaping.potential(R_E[:2], before, after, np.array([False, True]), 0.9, 2.0)
    np.testing.assert_allclose(reward, [-0.1 + 2 * (1.8 - 0.5), 100.0 - 1.0], rtol=1e-6)


def test_rewards_of_other_shapes_do_not_broadcast():
    with pytest.raises(ValueError, match=r"learned_reward: expected shape \(3,\), got \(3, 1\)"):
        shaping.additive(R_E, R_D[:, None])
    with pytest.raises(ValueError, match=r"after: expected shape \(3,\), got \(3, 1\)"):
        shaping.potential(R_E, R_D, R_D[:, None], np.zeros(3, bool), 0.9)
    with pytest.raises(TypeError, match="terminated: expected bool, got float32"):
        shaping.potential(R_E, R_D, R_D, np.zeros(3, np.float32), 0.9)
