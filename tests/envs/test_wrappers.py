"""Gymnasium's tasks that pay a learned reward."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from cmedirl_jax import envs
from cmedirl_jax.envs.wrappers import LearnedReward, LearnedRewardVector
from tests.support.host_tasks import Counting

DISCOUNT = 0.9


def learned(observation, action):
    """Tells steps, seeds and actions apart."""
    return 10.0 * observation[..., 1] + observation[..., 0] + 0.1 * action[..., 0]


def potential(observation, action):
    return observation[..., 1] ** 2 + observation[..., 0]


def paid(mode, seed, step, action, terminated, weight):
    """What step number `step` of `Counting` pays, whose own reward is the action."""
    before, after = np.array([seed, step]), np.array([seed, step + 1])
    if mode == "potential":
        following = 0.0 if terminated else potential(after, action)
        return action + weight * (DISCOUNT * following - potential(before, action))
    return weight * learned(before, np.array([action])) + (action if mode == "add" else 0.0)


@pytest.mark.parametrize("truncates", [False, True])
@pytest.mark.parametrize("mode", ["replace", "add", "potential"])
def test_an_episode_pays_what_the_mode_says(mode, truncates):
    reward = potential if mode == "potential" else learned
    env = LearnedReward(Counting(truncates), reward, mode, 0.5, DISCOUNT)
    env.reset(seed=5)
    for step in range(4):
        _, found, terminated, _, info = env.step(np.array([0.5]))
        assert terminated == (step == 3 and not truncates)
        assert found == pytest.approx(paid(mode, 5, step, 0.5, terminated, 0.5))
        assert info["environment_reward"] == 0.5


@pytest.mark.parametrize("autoreset", list(AutoresetMode))
@pytest.mark.parametrize("mode", ["replace", "add", "potential"])
def test_a_vector_pays_each_what_a_single_one_pays(mode, autoreset):
    reward = potential if mode == "potential" else learned
    inner = SyncVectorEnv([Counting] * 3, autoreset_mode=autoreset)
    vector = LearnedRewardVector(inner, reward, mode, 0.5, DISCOUNT)
    seeds = [3, 4, 5]
    vector.reset(seed=seeds)
    observed, over = np.array([[seed, 0] for seed in seeds]), np.zeros(3, bool)
    for _ in range(12):
        observations, found, terminated, truncated, infos = vector.step(np.full((3, 1), 0.5))
        for index, (seed, step) in enumerate(observed):
            if over[index]:
                # This step began an episode, and took no action.
                assert found[index] == 0.0
                continue
            expected = paid(mode, seed, step, 0.5, terminated[index], 0.5)
            assert found[index] == pytest.approx(expected)
            assert infos["environment_reward"][index] == 0.5
        ended = terminated | truncated
        over = ended if autoreset is AutoresetMode.NEXT_STEP else over
        observed = observations
        if autoreset is AutoresetMode.DISABLED and ended.any():
            observed, _ = vector.reset(seed=seeds, options={"reset_mask": ended})


def test_arrays_that_the_environment_writes_over_are_copied():
    vector = LearnedRewardVector(SyncVectorEnv([Counting] * 2, copy=False), learned)
    vector.reset(seed=[4, 5])
    _, found, *_ = vector.step(np.zeros((2, 1)))
    np.testing.assert_allclose(found, [4.0, 5.0])


def test_a_partial_reset_leaves_the_others_to_reset_themselves():
    vector = LearnedRewardVector(SyncVectorEnv([Counting] * 2), learned)
    vector.reset(seed=[3, 3])
    for _ in range(2):
        *_, terminated, _, _ = vector.step(np.zeros((2, 1)))
    assert terminated.all()
    vector.reset(seed=[4, None], options={"reset_mask": np.array([True, False])})
    _, found, *_ = vector.step(np.zeros((2, 1)))
    # Number 1 only began an episode.
    np.testing.assert_allclose(found, [4.0, 0.0])


def test_actions_are_read_within_their_bounds():
    env = LearnedReward(Counting(), lambda observation, action: action[..., 0])
    env.reset(seed=0)
    assert env.step(np.array([7.0]))[1] == 1.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mode": "instead"}, "mode: 'instead' is none of replace, add, potential"),
        ({"weight": np.inf}, "weight must be"),
        ({"discount": 1.5}, "discount must be"),
    ],
)
@pytest.mark.parametrize("wrapper", [LearnedReward, LearnedRewardVector])
def test_what_cannot_be_paid_is_refused(wrapper, given, message):
    inner = Counting() if wrapper is LearnedReward else SyncVectorEnv([Counting])
    with pytest.raises(ValueError, match=message):
        wrapper(inner, learned, **given)


def test_discrete_actions_are_refused_when_it_is_wrapped():
    with pytest.raises(ValueError, match=r"its actions are Discrete\(2\), not a Box"):
        LearnedReward(gymnasium.make("CartPole-v1"), learned)


def test_it_can_be_made_again_from_its_specification():
    env = LearnedReward(gymnasium.make("Pendulum-v1"), learned, mode="add", weight=0.5)
    again = gymnasium.make(env.spec)
    assert isinstance(again, LearnedReward)
    again.reset(seed=0)
    assert "environment_reward" in again.step(np.zeros(1, np.float32))[4]


def test_they_are_reached_through_envs():
    assert envs.wrappers.LearnedReward is LearnedReward
