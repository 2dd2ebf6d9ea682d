import numpy as np
import pytest

from cmedirl_jax.data import demonstrations as demonstrations_lib
from tests.support.episodes import played
from tests.support.samples import (
    CAPACITY,
    DRAWS,
    ENDED,
    EPISODES,
    OBSERVATIONS,
    POOL,
    RECENT,
    REPLAY,
    STEPS,
    SUBSET,
    WHOLE_DRAWS,
    assert_equal,
    numbers,
    run,
    take,
)


def test_uniform_pairs_are_the_plain_minibatches():
    demonstrations, sampled = take("uniform")
    _, stored, _, _ = run("uniform")
    assert_equal(demonstrations.transition, demonstrations_lib.at(POOL, DRAWS.demonstrations))
    assert_equal(sampled.transition, REPLAY.take(stored, DRAWS.background, RECENT))
    assert sampled.transition.reward.min() == STEPS - RECENT
    for batch in (demonstrations, sampled):
        np.testing.assert_array_equal(batch.log_density, np.zeros(60))
        np.testing.assert_array_equal(batch.mask, np.ones(60, bool))


def episodes_held():
    finished, stored = played(ENDED, CAPACITY)
    latest = finished[-EPISODES:]
    assert all(set(episode) <= set(stored) for episode in latest)
    return {episode for episode in latest if episode[0] >= STEPS - RECENT}


@pytest.mark.parametrize("weights", ["uniform", "recorded", "fusion"])
def test_trajectories_are_whole_episodes_in_order(weights):
    demonstrations, sampled = take(weights, "trajectory", draws=WHOLE_DRAWS)
    assert set(numbers(sampled)) == episodes_held()
    chosen = [SUBSET.start[which] for which in WHOLE_DRAWS.demonstrations]
    lengths = [SUBSET.length[which] for which in WHOLE_DRAWS.demonstrations]
    expected = [tuple(range(a, a + n)) for a, n in zip(chosen, lengths, strict=True)]
    assert numbers(demonstrations) == expected
    for batch, pool in ((demonstrations, POOL.observation), (sampled, np.float32(OBSERVATIONS))):
        assert batch.mask.shape == (60, 6)
        assert batch.log_density.shape == (60,)
        assert np.all(np.diff(np.int32(batch.mask)) <= 0)
        steps = np.int32(batch.transition.reward)[batch.mask]
        np.testing.assert_array_equal(batch.transition.observation[batch.mask], pool[steps])


@pytest.mark.parametrize("weights", ["uniform", "recorded", "fusion"])
def test_before_an_episode_has_ended_nothing_is_there_to_count(weights):
    _, sampled = take(weights, "trajectory", draws=WHOLE_DRAWS, steps=2)
    assert not sampled.mask.any()
    assert np.isfinite(sampled.log_density).all()
