"""The settings that all methods share."""

import dataclasses

from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.agents.exploration import ExplorationSettings
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.networks import Architecture
from cmedirl_jax.training.reward_sources import RewardSettings
from cmedirl_jax.training.schedules import RewardSchedule, Schedule


@dataclasses.dataclass(frozen=True)
class Settings(RewardSettings):
    """Every choice of an experiment that is not its size. The defaults are the `tuned` preset.

    The settings of the reward are those of `RewardSettings`.

    Attributes:
        architecture: actor and critic.
        agent: DDPG.
        exploration: the behaviour policy.
        reward_schedule: when the reward is learned, and how r_D is used.
        hot_start: how actor and critic start from the demonstrations.
        schedule: the training loop.
    """

    architecture: Architecture = Architecture()
    agent: DDPGHParams = DDPGHParams(behaviour_cloning=1.0)
    exploration: ExplorationSettings = ExplorationSettings()
    reward_schedule: RewardSchedule = RewardSchedule()
    hot_start: HotStartHParams = HotStartHParams()
    schedule: Schedule = Schedule()
