"""Settings that work on each task: those of `tuned`, of its experts, and for how long they train.

A task that is not in `TASKS` has the settings of MountainCarContinuous-v0, which is a guess; how to
find better ones is in docs/tuning.md. Add your own by `TASKS[name] = TaskSettings(...)`; which
settings they are is part of a run's configuration.
"""

import contextlib
import dataclasses
import importlib

from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.agents.exploration import ExplorationSettings, OrnsteinUhlenbeckHParams
from cmedirl_jax.envs import split_id
from cmedirl_jax.irl import IRLHParams
from cmedirl_jax.training.settings import Settings


@dataclasses.dataclass(frozen=True)
class TaskSettings:
    """What works on a task.

    Attributes:
        settings: of the learners.
        experts: of the experts, which are trained by DDPG on the true reward.
        steps: environment steps of a learner.
        expert_steps: environment steps of an expert.
    """

    settings: Settings = Settings()
    experts: Settings = Settings()
    steps: int = 12_000
    expert_steps: int = 14_000


# Of the bounds of r_D 0.02, 0.1, 0.3, 1 and 3; what they do is in docs/tuning.md.
_LARGER_REWARD = Settings(reward=IRLHParams(bound=0.3))

# The noise that the car needs would fell the pole at once; returns of 1,000 are scaled to 100.
_BALANCE = Settings(
    agent=DDPGHParams(reward_scale=0.1),
    exploration=ExplorationSettings(ornstein_uhlenbeck=OrnsteinUhlenbeckHParams(sigma=0.1)),
)

TASKS: dict[str, TaskSettings] = {
    "MountainCarContinuous-v0": TaskSettings(),
    "InvertedPendulum-v5": TaskSettings(_BALANCE, _BALANCE, steps=10_000, expert_steps=15_000),
    "Pendulum-v1": TaskSettings(_LARGER_REWARD, steps=10_000, expert_steps=10_000),
    "PointMass-v0": TaskSettings(_LARGER_REWARD, steps=10_000, expert_steps=10_000),
}
"""Maps the name of a task to what works on it."""


def of(task: str) -> TaskSettings:
    """What works on a task, by its name, with or without the `module:` that registers it."""
    return found(task) or TaskSettings()


def found(task: str) -> TaskSettings | None:
    """The entry of `TASKS` for a task, or None. Imports the task's module, which may add one."""
    module, name = split_id(task)
    if module:
        # What is wrong with the module is said where the task is made.
        with contextlib.suppress(Exception):
            importlib.import_module(module)
    return TASKS.get(task) or TASKS.get(name)
