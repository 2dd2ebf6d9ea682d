import dataclasses

import pytest

from cmedirl_jax import envs
from cmedirl_jax.agents.exploration import EpsilonGreedyHParams, GaussianHParams
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import METHODS, Settings

SPEC = envs.make("MountainCarContinuous-v0").spec
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
