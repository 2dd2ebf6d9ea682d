import numpy as np
import pytest

from cmedirl_jax.irl import RewardInfo
from cmedirl_jax.runs.cells.record import Budget, Means, Record
from cmedirl_jax.training import Log
from cmedirl_jax.training.evaluation import Evaluation
from cmedirl_jax.training.updates import Added

SEEDS, STEPS = 2, 6
BUDGET = Budget(max_steps=100, max_episodes=2, evaluate_every=STEPS, evaluation_starts=1)
FOUND = Evaluation(*(np.zeros(SEEDS) for _ in Evaluation._fields))


def log(start, *, done=(), learned=(), reward_learned=()):
    """A chunk whose every diagnostic is its step's number, seed 1's a hundred higher."""
    number = start + np.arange(STEPS) + 100.0 * np.arange(SEEDS)[:, None]
    ended = np.isin(np.arange(STEPS), done) & np.array([[True], [False]])

    def at(steps):
        return np.broadcast_to(np.isin(np.arange(STEPS), steps), number.shape)

    return Log(
        done=ended,
        terminated=ended,
        episode_return=number,
        episode_length=number,
        learned=at(learned),
        critic_loss=2 * number,
        q_mean=number,
        added=Added(3 * number, 4 * number),
        reward_learned=at(reward_learned),
        reward=RewardInfo(*(k * number for k in range(1, 7))),
    )


def test_means_are_over_the_updates_of_each_kind_since_the_last_evaluation():
    record = Record(SEEDS, BUDGET)
    record.stepped(np.arange(STEPS), log(0, learned=[1, 3], reward_learned=[2, 4, 5]))
    record.evaluated("episodes", np.array([1]), FOUND)
    record.evaluated("steps", np.arange(SEEDS), FOUND)
    record.stepped(STEPS + np.arange(STEPS), log(STEPS, learned=[0]))
    record.evaluated("steps", np.arange(SEEDS), FOUND)
    by_episodes, first, second = (found.means for found in record.evaluations)
    reward = np.mean([2, 4, 5])
    np.testing.assert_allclose(
        np.stack(first),
        [
            [2, 102],
            [4, 204],
            [6, 306],
            [8, 408],
            *(k * np.array([reward, reward + 100]) for k in (1, 2, 6)),
        ],
    )
    np.testing.assert_array_equal([mean[0] for mean in by_episodes], [mean[1] for mean in first])
    np.testing.assert_array_equal(np.stack(second[:4]), [[6, 106], [12, 212], [18, 318], [24, 424]])
    assert np.isnan(second[4:]).all()


def test_what_a_seed_does_past_its_last_episode_is_not_its_own():
    record = Record(SEEDS, BUDGET)
    record.stepped(np.arange(STEPS), log(0, done=[1, 3], learned=range(6), reward_learned=range(6)))
    record.evaluated("steps", np.arange(SEEDS), FOUND)
    (found,) = record.evaluations
    assert found.env_step.tolist() == [4, 6]
    assert found.means.q_mean.tolist() == [np.mean(range(4)), 100 + np.mean(range(6))]
    assert found.means.demonstration_reward[0] == pytest.approx(np.mean(range(4)))
    assert record.running.tolist() == [False, True]


def test_a_method_without_a_reward_has_none_of_its_means():
    record = Record(SEEDS, BUDGET)
    chunk = log(0, learned=[1], reward_learned=[1])._replace(reward=None, added=None)
    record.stepped(np.arange(STEPS), chunk)
    record.evaluated("steps", np.arange(SEEDS), FOUND)
    means = record.evaluations[0].means
    assert Means._fields[2:] == (
        "r_d_mean",
        "r_d_mean_square",
        "demonstration_reward",
        "background_reward",
        "effective_sample_size",
    )
    assert np.isnan(means[2:]).all()
    assert np.isfinite(means[:2]).all()
