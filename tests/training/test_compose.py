import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import (
    METHODS,
    ExplorationSettings,
    RewardNetworkSettings,
    Settings,
)
from cmedirl_jax.training.schedules import RewardSchedule, Schedule

SPEC = envs.make("MountainCarContinuous-v0").spec


@pytest.mark.parametrize("name", METHODS)
def test_a_reward_is_made_only_where_the_method_has_one(name):
    algorithm = compose.compose(SPEC, METHODS[name], Settings(), capacity=10)
    assert (algorithm.learner is None) == (name in ("ddpg", "hs-ddpg", "bc"))
    assert (algorithm.background is not None) == METHODS[name].learns_reward


@pytest.mark.parametrize(("own", "capacity"), [(None, 10), (7, 7)])
def test_the_schedules_replay_capacity_comes_first(own, capacity):
    settings = dataclasses.replace(Settings(), schedule=Schedule(replay_capacity=own))
    algorithm = compose.compose(SPEC, METHODS["ddpg"], settings, capacity=10)
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
    exploration = compose.make_exploration(SPEC, ExplorationSettings(kind=kind))
    assert type(exploration.init(None)).__name__ == state


@pytest.mark.parametrize(
    ("kind", "scaled"),
    [
        ("ornstein-uhlenbeck", ("sigma",)),
        ("gaussian", ("scale",)),
        ("epsilon-greedy", ("epsilon_start", "epsilon_end")),
    ],
)
def test_only_hot_started_methods_scale_their_noise(kind, scaled):
    settings = ExplorationSettings(kind=kind, hot_start_factor=0.25)
    composed = dataclasses.replace(Settings(), exploration=settings)

    def hparams(exploration):
        state = exploration.init(None)
        return dataclasses.asdict(getattr(state, "hparams", state))

    own = dataclasses.asdict(getattr(settings, kind.replace("-", "_")))
    for name, factor in (("ddpg", 1.0), ("hs-ddpg", 0.25)):
        found = hparams(compose.compose(SPEC, METHODS[name], composed, capacity=10).exploration)
        assert found == {k: pytest.approx(factor * v if k in scaled else v) for k, v in own.items()}


@pytest.mark.parametrize("kind", ["deep", "radial-basis", "fourier"])
def test_a_potential_is_a_function_of_the_state_whatever_the_network(kind):
    settings = dataclasses.replace(
        Settings(),
        reward_network=RewardNetworkSettings(kind=kind, hidden=(4,), centres=3),
        reward_schedule=RewardSchedule(shaping="potential"),
    )
    learner = compose.compose(SPEC, METHODS["me-ddpg"], settings, capacity=10).learner
    state = learner.init(jax.random.key(0))
    state = state.replace(
        params=jax.tree.map(
            lambda leaf: leaf + jnp.linspace(0.1, 0.5, leaf.size).reshape(leaf.shape), state.params
        )
    )
    observation = jnp.array([[-0.5, 0.01], [0.2, 0.0]])
    potential, other = (learner.reward(state, observation, a * jnp.ones((2, 1))) for a in (-1, 1))
    np.testing.assert_array_equal(potential, other)
    assert potential[0] != potential[1]
