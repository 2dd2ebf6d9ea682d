"""Pools that are of the task pass, others are refused by their first wrong step."""

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import rounding
from cmedirl_jax.data import demonstrations
from cmedirl_jax.types import Demonstrations, Transition
from tests.support import pools

ENV, SPEC = pools.ENV, pools.ENV.spec
POOL = pools.scripted(2)
LENGTHS = demonstrations.episodes(POOL).length


def changed(field, row, change):
    """The scripted pool with another value in a row of a field."""
    array = np.array(getattr(POOL.transition, field))
    array[row] = change(array[row])
    return POOL._replace(transition=POOL.transition._replace(**{field: array}))


def of_gymnasium(pushes, seed=0):
    """An episode of Gymnasium's for each push in the direction of motion, with noise."""
    rng = np.random.default_rng(seed)
    car = gymnasium.make(SPEC.id)
    rows = []
    for episode, push in enumerate(pushes):
        observation, _ = car.reset(seed=seed + episode)
        ended = False
        while not ended:
            noise = 0.2 * rng.standard_normal(1)
            action = np.clip(push * np.sign(observation[1:]) + noise, -1, 1).astype(np.float32)
            following, reward, terminated, truncated, _ = car.step(action)
            ended = terminated or truncated
            rows.append((observation, action, reward, following, terminated, truncated, episode))
            observation = following
    *columns, truncated, episode = (np.array(column) for column in zip(*rows, strict=True))
    car.close()
    return Demonstrations(Transition(*columns), truncated, episode, {"env": SPEC.id})


def test_episodes_of_gymnasium_are_of_the_task_to_less_than_a_rounding(monkeypatch):
    pool = of_gymnasium([0.7, 0.0])
    assert pool.transition.reward.dtype == np.float64
    assert pool.transition.terminated.sum() == pool.truncated.sum() == 1
    demonstrations.check(pool, ENV)
    monkeypatch.setattr(rounding, "ROUNDINGS", 1.0)
    demonstrations.check(pool, ENV)


def test_our_own_episodes_are_of_the_task():
    demonstrations.check(POOL, ENV)


LAST = LENGTHS[0] - 1


@pytest.mark.parametrize(
    ("field", "row", "change", "message"),
    [
        ("reward", 3, lambda _: 0.0, "episode 0, step 3: reward is 0, .* makes it -0.009"),
        ("reward", LAST + 8, lambda r: 1.01 * r, "episode 1, step 7: reward is -0.00909"),
        ("action", 5, lambda a: a + 0.01, r"episode 0, step 5: next_observation\[\d\] is "),
        ("terminated", LAST, lambda _: False, f"episode 0, step {LAST}: terminated is 0, .* 1 "),
        ("terminated", -1, lambda _: False, "episode 1, step .*: terminated is 0, .* 1 "),
    ],
)
def test_a_step_that_the_task_would_not_make_is_refused(field, row, change, message):
    pool = changed(field, row, change)
    truncated = np.asarray(POOL.transition.terminated) & ~np.asarray(pool.transition.terminated)
    pool = pool._replace(truncated=truncated)
    demonstrations.validate(pool, SPEC)
    with pytest.raises(ValueError, match=rf"^{message}.*\(tolerance [0-9.]+e-\d\d\)$"):
        demonstrations.check(pool, ENV)


def test_a_pool_of_other_physics_is_refused_at_its_first_step():
    params = ENV.default_params.replace(gravity=1.001 * ENV.default_params.gravity)
    message = r"^episode 0, step 0: next_observation\[1\] is 0.001\d+, .* \(tolerance 4.1e-07\)$"
    with pytest.raises(ValueError, match=message):
        demonstrations.check(POOL, ENV, params)


def test_a_task_that_answers_with_nan_has_made_no_pool():
    def step(key, state, action, params):
        state, answer = ENV.step(key, state, action, params)
        return state, answer._replace(reward=answer.reward * jnp.nan)

    with pytest.raises(ValueError, match=r"step 0: reward is -0.009.* makes it nan"):
        demonstrations.check(POOL, ENV._replace(step=step))


EDGE = 0.4207591
"""From here a car of velocity 0.03 just reaches the goal, and from a rounding further left not."""


def reaching(position):
    """A step of that car which was recorded as reaching the goal."""
    observation = np.array([[position, 0.03]], np.float32)
    following = np.array([[0.45, 0.03 - 0.0025 * np.cos(3.0 * EDGE)]], np.float32)
    no_action, reward = np.zeros((1, 1), np.float32), np.array([100.0], np.float32)
    transition = Transition(observation, no_action, reward, following, np.ones(1, bool))
    return Demonstrations(transition, np.zeros(1, bool), np.zeros(1, np.int32), POOL.metadata)


def test_where_rounding_decides_whether_the_goal_is_reached_both_are_right():
    demonstrations.check(reaching(EDGE - 5e-8), ENV)
    with pytest.raises(ValueError, match=r"step 0: reward is 100, .* makes it -?0 "):
        demonstrations.check(reaching(EDGE - 5e-6), ENV)


def test_a_task_that_cannot_be_set_to_a_state_holds_pools_to_its_specification():
    blind = ENV._replace(state_at=None)
    demonstrations.check(changed("reward", 3, lambda _: 0.0), blind)
    with pytest.raises(ValueError, match="next_observation"):
        demonstrations.check(changed("observation", 3, lambda seen: 0.5 * seen), blind)


@pytest.mark.parametrize(
    ("field", "row", "change", "message"),
    [
        (
            "observation",
            LAST + 4,
            lambda seen: np.add(seen, [0.0, 0.1]),
            r"episode 1, step 3: observation\[1\] is 0.0[89]\d*, .* keeps it in -0.07 to 0.07",
        ),
        (
            "next_observation",
            LAST,
            lambda seen: np.add(seen, [0.2, 0.0]),
            rf"episode 0, step {LAST}: next_observation\[0\] is 0.6\d*, .* in -1.2 to 0.6",
        ),
        (
            "next_observation",
            LAST - 1,
            lambda seen: seen - [1e-4, 0.0],
            rf"episode 0, step {LAST - 1}: next_observation\[0\] is 0.\d+, the following step's "
            r"observation is 0.\d+ \(tolerance 1.\de-05\)",
        ),
    ],
)
def test_a_pool_that_leaves_the_bounds_or_jumps_is_refused(field, row, change, message):
    pool = changed(field, row, change)
    demonstrations.validate(pool)
    with pytest.raises(ValueError, match=rf"^{message}$"):
        demonstrations.validate(pool, SPEC)
    changed_at_the_end = changed("next_observation", LAST, lambda seen: seen - 1e-4)
    demonstrations.validate(changed_at_the_end, SPEC)


@pytest.mark.parametrize("unbounded", [np.inf, np.finfo(np.float32).max])
def test_bounds_may_be_infinite_on_either_side(unbounded):
    pool = changed("observation", 0, lambda seen: np.subtract(seen, [7.0, 0.0]))
    high = np.array([unbounded, 0.07])
    wide = SPEC._replace(observation_low=-high, observation_high=high)
    demonstrations.validate(pool, wide)
    half = SPEC._replace(observation_high=high)
    with pytest.raises(ValueError, match=r"observation\[0\] is -7.\d+, .* keeps it in -1.2 to "):
        demonstrations.validate(pool, half)
