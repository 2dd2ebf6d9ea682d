import dataclasses

import pytest

from cmedirl_jax import envs, methods
from cmedirl_jax.methods import METHODS, ExplorationSettings, Settings
from cmedirl_jax.schedules import Schedule

SPEC = envs.make("MountainCarContinuous-v0").spec


def test_the_papers_methods_are_the_four_combinations_of_its_two_parts():
    parts = {name: (method.hot_start, method.learned_reward) for name, method in METHODS.items()}
    assert parts == {
        "ddpg": (False, False),
        "hs-ddpg": (True, False),
        "me-ddpg": (False, True),
        "hs-me-ddpg": (True, True),
    }
    assert [m.uses_demonstrations for m in METHODS.values()] == [False, True, True, True]
    assert all(name == method.name for name, method in METHODS.items())


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_reward_is_learned_only_where_the_method_has_one(method):
    algorithm = methods.compose(SPEC, method, Settings(), capacity=10)
    assert (algorithm.learner is not None) == method.learned_reward


@pytest.mark.parametrize(("own", "capacity"), [(None, 10), (7, 7)])
def test_the_schedules_replay_capacity_comes_first(own, capacity):
    settings = dataclasses.replace(Settings(), schedule=Schedule(replay_capacity=own))
    algorithm = methods.compose(SPEC, METHODS["ddpg"], settings, capacity=10)
    assert algorithm.replay.init().storage.shape[0] == capacity


@pytest.mark.parametrize(
    ("kind", "state"),
    [
        ("ornstein-uhlenbeck", "OrnsteinUhlenbeckState"),
        ("gaussian", "GaussianHParams"),
        ("epsilon-greedy", "HeldActionState"),
    ],
)
def test_every_exploration_can_be_named(kind, state):
    exploration = methods.make_exploration(SPEC, ExplorationSettings(kind=kind))
    assert type(exploration.init(None)).__name__ == state
