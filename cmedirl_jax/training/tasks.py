"""Settings that work on each task: those of `tuned`, of its experts, and for how long they train.

A task that is not in `TASKS` has the settings of MountainCarContinuous-v0, which is a guess; how to
find better ones is in docs/tasks.md. Add your own by `TASKS[name] = TaskSettings(...)`.
"""

import dataclasses

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


TASKS: dict[str, TaskSettings] = {}
"""Maps the name of a task to what works on it."""


def of(task: str) -> TaskSettings:
    """What works on a task, by its name."""
    return TASKS.get(task, TaskSettings())
