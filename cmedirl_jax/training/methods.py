"""The methods, each one line of composition, and the settings they share."""

import dataclasses
from typing import Literal, NamedTuple

from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.agents.exploration import ExplorationSettings
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.irl import GAILHParams, IRLHParams
from cmedirl_jax.irl.reward_batches import RewardBatchSettings
from cmedirl_jax.irl.rewards import RewardNetworkSettings
from cmedirl_jax.irl.shaping import Shaping
from cmedirl_jax.networks import Architecture
from cmedirl_jax.tabular import imitation
from cmedirl_jax.tabular.imitation import TabularSettings
from cmedirl_jax.training.schedules import RewardSchedule, Schedule

Reward = Literal[
    "maxent", "gail", "tabular-linear", "tabular-deep", "random", "plus-constant", "minus-constant"
]


class Method(NamedTuple):
    """A method as a composition of the library's parts.

    Attributes:
        name: as the command line and the tables write it.
        description: in a line.
        hot_start: whether actor and critic start from the demonstrations (Eq. 11). With
            `schedule.cloning` the actor also goes on imitating them, for a while or throughout.
        reward: where r_D comes from, or None:
            "maxent", learned from samples (Algorithm 1); "gail", from a discriminator;
            "tabular-linear" and "tabular-deep", frozen, by dynamic programming on a grid of the
            environment (Eqs. 6-9); and controls that say nothing of the task: "random", a frozen
            random network, "plus-constant" and "minus-constant", the bound of "maxent" everywhere.
        shaping: how r_D joins r_e, unless the settings say otherwise.
        interacts: whether DDPG learns in the environment; if not, the method's policy is that of
            its hot start, or the soft-optimal one of the tabular reward.
    """

    name: str
    description: str
    hot_start: bool = False
    reward: Reward | None = None
    shaping: Shaping = "additive"
    interacts: bool = True

    @property
    def learns_reward(self) -> bool:
        """Whether r_D is learned while DDPG learns."""
        return self.reward in ("maxent", "gail")

    @property
    def tabular(self) -> imitation.Kind | None:
        """Kind of a reward by dynamic programming, or None."""
        kinds: dict[str | None, imitation.Kind] = {
            "tabular-linear": "linear",
            "tabular-deep": "deep",
        }
        return kinds.get(self.reward)

    @property
    def uses_demonstrations(self) -> bool:
        """Whether the method reads demonstrations at all."""
        return self.hot_start or self.learns_reward or self.tabular is not None


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("ddpg", "DDPG on the environment's reward, no demonstrations"),
        Method("hs-ddpg", "DDPG hot-started, then cloning that fades", hot_start=True),
        Method("me-ddpg", "DDPG on r_D + r_e", reward="maxent"),
        Method("hs-me-ddpg", "both (Algorithm 2)", hot_start=True, reward="maxent"),
        Method("bc", "supervised learning: the hot start alone", hot_start=True, interacts=False),
        Method("irl-only", "DDPG on r_D alone", reward="maxent", shaping="alone"),
        Method("gail", "DDPG on a discriminator's reward alone", reward="gail", shaping="alone"),
        Method("tabular-me-ddpg", "r_D + r_e, r_D of deep-maxent-irl", reward="tabular-deep"),
        Method("maxent-irl", "by a model, linear", reward="tabular-linear", interacts=False),
        Method("deep-maxent-irl", "by a model, deep", reward="tabular-deep", interacts=False),
        Method("ddpg-plus-constant", "control: r_e + constant", reward="plus-constant"),
        Method("ddpg-minus-constant", "control: r_e - constant", reward="minus-constant"),
        Method("random-reward", "control: r_e + a frozen random r_D", reward="random"),
    )
}


PAPER_METHODS = ("ddpg", "hs-ddpg", "me-ddpg", "hs-me-ddpg")
"""The four that the paper names."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Every choice of an experiment that is not its size. The defaults are the `tuned` preset."""

    architecture: Architecture = Architecture()
    agent: DDPGHParams = DDPGHParams(behaviour_cloning=1.0)
    exploration: ExplorationSettings = ExplorationSettings()
    reward: IRLHParams = IRLHParams()
    gail: GAILHParams = GAILHParams()
    reward_network: RewardNetworkSettings = RewardNetworkSettings()
    reward_schedule: RewardSchedule = RewardSchedule()
    reward_batches: RewardBatchSettings = RewardBatchSettings()
    hot_start: HotStartHParams = HotStartHParams()
    schedule: Schedule = Schedule()
    tabular: TabularSettings = TabularSettings()
