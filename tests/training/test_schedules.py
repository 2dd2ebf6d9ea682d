import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.training import schedules
from cmedirl_jax.training.schedules import RewardSchedule, Schedule


def plans(schedule=None, reward=None, steps=60):
    schedule = schedule or Schedule()
    reward = reward or RewardSchedule()
    return jax.vmap(lambda step: schedules.plan(step, schedule, reward))(jnp.arange(steps))


def test_predicates_by_counting():
    found = plans(
        Schedule(learning_starts=10, update_period=3, target_period=7, frozen_actor_steps=25),
        RewardSchedule(period=4, stop=30),
    )
    steps = range(60)
    assert np.flatnonzero(found.learn).tolist() == [t for t in steps if t >= 10 and t % 3 == 0]
    assert np.flatnonzero(found.update_actor).tolist() == [t for t in steps if t >= 25]
    # Targets move with the first update at or after each multiple of their period.
    moved = np.flatnonzero(found.learn & found.update_targets).tolist()
    assert moved == [t for t in range(12, 60, 3) if any(u % 7 == 0 for u in range(t - 2, t + 1))]
    assert np.flatnonzero(found.learn_reward).tolist() == [12, 16, 20, 24, 28]


def test_a_reward_that_never_stops_and_is_never_annealed():
    found = plans(Schedule(learning_starts=0), RewardSchedule(period=1, stop=None))
    assert found.learn_reward.all()
    assert (found.reward_weight == 1.0).all()


def test_weights_fall_linearly_to_zero_and_stay_there():
    found = plans(Schedule(behaviour_cloning_steps=50), RewardSchedule(anneal_steps=20))
    steps = np.arange(60)
    np.testing.assert_allclose(found.cloning_weight, np.clip(1 - steps / 50, 0, 1), atol=1e-6)
    np.testing.assert_allclose(found.reward_weight, np.clip(1 - steps / 20, 0, 1), atol=1e-6)


@pytest.mark.parametrize(("cloning", "weight"), [("none", 0.0), ("constant", 1.0)])
def test_cloning_that_does_not_fade(cloning, weight):
    found = plans(Schedule(cloning=cloning, behaviour_cloning_steps=50))
    np.testing.assert_array_equal(found.cloning_weight, np.full(60, weight))


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"schedule": Schedule(update_period=0)}, "update_period"),
        ({"schedule": Schedule(target_period=0)}, "target_period"),
        ({"schedule": Schedule(behaviour_cloning_steps=0)}, "behaviour_cloning_steps"),
        ({"reward": RewardSchedule(period=0)}, "period"),
        ({"reward": RewardSchedule(anneal_steps=0)}, "anneal_steps"),
    ],
)
def test_periods_are_positive(given, name):
    with pytest.raises(ValueError, match=f"^{name} must be at least 1, got 0"):
        plans(**given)


def test_steps_are_counted_one_at_a_time():
    for step, error in ((jnp.arange(3), ValueError), (jnp.zeros(()), TypeError)):
        with pytest.raises(error, match="step: expected"):
            schedules.plan(step, Schedule(), RewardSchedule())
