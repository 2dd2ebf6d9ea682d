import numpy as np
import pytest

from cmedirl_jax.data import hot_start_data
from tests.support import pools


def test_returns_are_discounted_within_each_episode():
    pool = pools.scripted(2)
    data = hot_start_data.prepare(pool, 0.9, 2.0)
    episode, reward = np.asarray(pool.episode), np.float64(pool.transition.reward)
    for number in range(2):
        rewards = reward[episode == number]
        expected = [
            2.0 * sum(0.9**k * r for k, r in enumerate(rewards[t:])) for t in range(rewards.size)
        ]
        np.testing.assert_allclose(
            data.discounted_return[episode == number], expected, rtol=1e-5, atol=1e-6
        )
    np.testing.assert_array_equal(data.episodes.length, np.bincount(episode))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"discount": 2.0}, "discount must be between 0 and 1, got 2.0"),
        ({"discount": float("nan")}, "discount must be between 0 and 1, got nan"),
        ({"reward_scale": -1.0}, "reward_scale must be positive and finite, got -1.0"),
        ({"reward_scale": float("inf")}, "reward_scale must be positive and finite, got inf"),
    ],
)
def test_impossible_discounts_and_scales_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        hot_start_data.prepare(pools.scripted(2), **given)
