import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs
from cmedirl_jax.agents.exploration import (
    EpsilonGreedyHParams,
    ExplorationSettings,
    GaussianHParams,
)
from cmedirl_jax.irl.rewards import RewardNetworkSettings
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.schedules import RewardSchedule, Schedule
from cmedirl_jax.training.settings import Settings

SPEC = envs.make("MountainCarContinuous-v0").spec


@pytest.mark.parametrize("name", METHODS)
def test_a_reward_is_made_only_where_the_method_has_one(name):
    algorithm = compose.compose(SPEC, METHODS[name], Settings(), capacity=10)
    assert (algorithm.learner is None) == (name in ("ddpg", "hs-ddpg", "bc"))
    assert (algorithm.sampler is not None) == METHODS[name].learns_reward


@pytest.mark.parametrize(("own", "capacity"), [(None, 10), (7, 7)])
def test_the_schedules_replay_capacity_comes_first(own, capacity):
    settings = dataclasses.replace(Settings(), schedule=Schedule(replay_capacity=own))
    algorithm = compose.compose(SPEC, METHODS["ddpg"], settings, capacity=10)
    assert algorithm.replay.init().storage.shape[0] == capacity


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


BIG = {"schedule": {"replay_capacity": 1000}}


@pytest.mark.parametrize(
    ("name", "changes", "named"),
    [
        (
            "me-ddpg",
            {"reward_schedule": {"shaping": "potential"}, "reward": {"absorbing": True}},
            "leave reward.absorbing",
        ),
        ("me-ddpg", {"agent": {"discount": 1.0}, "reward": {"absorbing": True}}, "agent.discount"),
        ("tabular-me-ddpg", {"reward_schedule": {"shaping": "potential"}}, "tabular.reward state"),
        ("random-reward", {"reward_network": {"kind": "fourier"}}, "reward_network.kind deep"),
        ("me-ddpg", {"reward": {"bound": float("inf")}}, "reward.bounded_by none"),
        ("ddpg-plus-constant", {"reward": {"bound": float("nan")}}, "reward.bounded_by none"),
        ("gail", {"reward_schedule": {"shaping": "additive"}}, "leave reward_schedule.shaping"),
        ("irl-only", {"reward_schedule": {"anneal_steps": 9}}, "anneal_steps"),
        (
            "me-ddpg",
            {"agent": {"bootstrap_at_termination": True}, "reward": {"absorbing": True}},
            "bootstrap_at_termination",
        ),
        (
            "me-ddpg",
            {"reward": {"absorbing": True, "bounded_by": "none"}},
            "another reward.bounded_by",
        ),
        ("me-ddpg", {"reward": {"objective": "trajectory"}}, "schedule.replay_capacity"),
        (
            "me-ddpg",
            {"reward_batches": {"weights": "fusion", "recent": None}},
            "reward_batches.recent 2000",
        ),
        (
            "me-ddpg",
            {
                "reward": {"objective": "trajectory"},
                "reward_batches": {"weights": "fusion"},
                **BIG,
            },
            "exploration.kind gaussian",
        ),
        (
            "me-ddpg",
            {
                "exploration": {"kind": "gaussian", "gaussian": GaussianHParams(scale=0.0)},
                "reward_batches": {"weights": "recorded"},
            },
            "gaussian.scale above 0",
        ),
        (
            "me-ddpg",
            {
                "exploration": {"kind": "epsilon-greedy"},
                "reward": {"objective": "trajectory"},
                "reward_batches": {"weights": "recorded"},
                **BIG,
            },
            "epsilon_greedy.noise",
        ),
        (
            "me-ddpg",
            {
                "exploration": {"kind": "epsilon-greedy"},
                "reward_batches": {"weights": "fusion"},
            },
            "epsilon_greedy.noise",
        ),
        (
            "me-ddpg",
            {
                "exploration": {
                    "kind": "epsilon-greedy",
                    "epsilon_greedy": EpsilonGreedyHParams(hold=4.0, noise=0.1),
                },
                "reward": {"objective": "trajectory"},
                "reward_batches": {"weights": "recorded"},
                **BIG,
            },
            "epsilon_greedy.hold 1",
        ),
    ],
)
def test_parts_that_do_not_fit_each_other_are_refused_naming_the_option(name, changes, named):
    groups = {
        group: dataclasses.replace(getattr(Settings(), group), **fields)
        for group, fields in changes.items()
    }
    settings = dataclasses.replace(Settings(), **groups)
    with pytest.raises(ValueError, match=named):
        compose.compose(SPEC, METHODS[name], settings, capacity=10)
