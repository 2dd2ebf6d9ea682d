"""The methods, each one line of composition, and the settings they share."""

import dataclasses
from typing import Literal, NamedTuple

from cmedirl_jax import ddpg, exploration, irl, networks, replay, rewards
from cmedirl_jax.ddpg import DDPG, DDPGHParams
from cmedirl_jax.exploration import (
    EpsilonGreedyHParams,
    Exploration,
    GaussianHParams,
    OrnsteinUhlenbeckHParams,
)
from cmedirl_jax.hot_start import HotStartHParams
from cmedirl_jax.irl import IRLHParams, RewardLearner
from cmedirl_jax.networks import Architecture
from cmedirl_jax.replay import Replay
from cmedirl_jax.schedules import RewardSchedule, Schedule
from cmedirl_jax.tabular import frozen, imitation
from cmedirl_jax.tabular.imitation import TabularSettings
from cmedirl_jax.types import EnvSpec


class Method(NamedTuple):
    """A method as a composition of the library's parts.

    Attributes:
        name: as the command line and the tables write it.
        description: in a line.
        hot_start: whether actor and critic start from the demonstrations (Eq. 11). With
            `schedule.cloning` the actor also goes on imitating them, for a while or throughout.
        learned_reward: whether r_D is learned (Algorithm 1) and added to r_e (Eq. 10).
        tabular_reward: maximum-entropy IRL by dynamic programming on a grid of the environment
            (Eqs. 6-9), with a "linear" or a "deep" reward, or None. That reward is r_D, frozen.
        interacts: whether DDPG learns in the environment; if not, the method's policy is the
            soft-optimal one of the tabular reward.
    """

    name: str
    description: str
    hot_start: bool = False
    learned_reward: bool = False
    tabular_reward: imitation.Kind | None = None
    interacts: bool = True

    @property
    def uses_demonstrations(self) -> bool:
        """Whether the method reads demonstrations at all."""
        return self.hot_start or self.learned_reward or self.tabular_reward is not None


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("ddpg", "DDPG on the environment's reward, no demonstrations"),
        Method("hs-ddpg", "DDPG hot-started, then cloning that fades", hot_start=True),
        Method("me-ddpg", "DDPG on r_D + r_e", learned_reward=True),
        Method("hs-me-ddpg", "both (Algorithm 2)", hot_start=True, learned_reward=True),
        Method(
            "tabular-me-ddpg", "DDPG on r_D + r_e, r_D of deep-maxent-irl", tabular_reward="deep"
        ),
        Method(
            "maxent-irl",
            "maximum-entropy IRL with a model, theta^T phi",
            tabular_reward="linear",
            interacts=False,
        ),
        Method(
            "deep-maxent-irl",
            "the same with a network",
            tabular_reward="deep",
            interacts=False,
        ),
    )
}


PAPER_METHODS = ("ddpg", "hs-ddpg", "me-ddpg", "hs-me-ddpg")
"""The four that the paper names."""


@dataclasses.dataclass(frozen=True)
class ExplorationSettings:
    """The behaviour policy."""

    kind: Literal["ornstein-uhlenbeck", "gaussian", "epsilon-greedy"] = "ornstein-uhlenbeck"
    """Which noise; the options of the others are ignored."""
    hot_start_factor: float = 1.0
    """Factor on the noise of a hot-started method: on sigma, on the scale, or on both epsilons."""
    ornstein_uhlenbeck: OrnsteinUhlenbeckHParams = OrnsteinUhlenbeckHParams()
    gaussian: GaussianHParams = GaussianHParams()
    epsilon_greedy: EpsilonGreedyHParams = EpsilonGreedyHParams()


@dataclasses.dataclass(frozen=True)
class Settings:
    """Every choice of an experiment that is not its size. The defaults are the `tuned` preset."""

    architecture: Architecture = Architecture()
    agent: DDPGHParams = DDPGHParams(behaviour_cloning=1.0)
    exploration: ExplorationSettings = ExplorationSettings()
    reward: IRLHParams = IRLHParams()
    reward_schedule: RewardSchedule = RewardSchedule()
    hot_start: HotStartHParams = HotStartHParams()
    schedule: Schedule = Schedule()
    tabular: TabularSettings = TabularSettings()


class Algorithm(NamedTuple):
    """A method's parts, made for an environment.

    Attributes:
        agent: DDPG.
        learner: learner of r_D, or None.
        exploration: the behaviour policy.
        replay: the buffer.
    """

    agent: DDPG
    learner: RewardLearner | None
    exploration: Exploration
    replay: Replay


def compose(spec: EnvSpec, method: Method, settings: Settings, capacity: int) -> Algorithm:
    """Make a method's parts; `capacity` is the replay's where the settings leave it open."""
    learner = None
    if method.tabular_reward is not None:
        learner = frozen.make(*imitation.grids(spec, settings.tabular), settings.reward)
    elif method.learned_reward:
        network = rewards.mlp(spec, settings.reward_schedule.hidden)
        learner = irl.make(spec, settings.reward, network=network)
    return Algorithm(
        agent=ddpg.make(spec, settings.agent, networks=networks.make(spec, settings.architecture)),
        learner=learner,
        exploration=make_exploration(spec, settings.exploration, hot_start=method.hot_start),
        replay=replay.make(spec, settings.schedule.replay_capacity or capacity),
    )


def make_exploration(
    spec: EnvSpec, settings: ExplorationSettings, *, hot_start: bool = False
) -> Exploration:
    """The behaviour policy that `settings.kind` names, for a hot-started method or another."""
    factor = settings.hot_start_factor if hot_start else 1.0
    match settings.kind:
        case "ornstein-uhlenbeck":
            noise = settings.ornstein_uhlenbeck
            return exploration.ornstein_uhlenbeck(spec, noise.replace(sigma=factor * noise.sigma))
        case "gaussian":
            noise = settings.gaussian
            return exploration.gaussian(spec, noise.replace(scale=factor * noise.scale))
        case "epsilon-greedy":
            noise = settings.epsilon_greedy
            scaled = noise.replace(
                epsilon_start=factor * noise.epsilon_start, epsilon_end=factor * noise.epsilon_end
            )
            return exploration.epsilon_greedy(spec, scaled)
