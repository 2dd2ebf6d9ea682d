"""The methods, each one line of composition, and the settings they share."""

import dataclasses
from typing import Literal, NamedTuple

from cmedirl_jax import background, ddpg, exploration, irl, networks, replay, rewards
from cmedirl_jax.background import Background
from cmedirl_jax.ddpg import DDPG, DDPGHParams
from cmedirl_jax.exploration import (
    EpsilonGreedyHParams,
    Exploration,
    GaussianHParams,
    OrnsteinUhlenbeckHParams,
)
from cmedirl_jax.hot_start import HotStartHParams
from cmedirl_jax.irl import GAILHParams, IRLHParams, RewardLearner
from cmedirl_jax.networks import Architecture
from cmedirl_jax.replay import Replay
from cmedirl_jax.schedules import RewardSchedule, Schedule
from cmedirl_jax.shaping import Shaping
from cmedirl_jax.tabular import frozen, imitation
from cmedirl_jax.tabular.imitation import TabularSettings
from cmedirl_jax.types import EnvSpec, Network

Reward = Literal[
    "maxent", "gail", "tabular-linear", "tabular-deep", "random", "plus-constant", "minus-constant"
]


class Method(NamedTuple):
    """A method as a composition of the library's parts.

    Attributes:
        name: as the command line and the tables write it.
        description: in a line.
        hot_start: whether actor and critic start from the demonstrations (Eq. 11). With
            `schedule.behaviour_cloning_steps` the actor also goes on imitating them for a while.
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
class ExplorationSettings:
    """The behaviour policy."""

    kind: Literal["ornstein-uhlenbeck", "gaussian", "epsilon-greedy"] = "ornstein-uhlenbeck"
    """Which noise; the options of the others are ignored."""
    ornstein_uhlenbeck: OrnsteinUhlenbeckHParams = OrnsteinUhlenbeckHParams()
    gaussian: GaussianHParams = GaussianHParams()
    epsilon_greedy: EpsilonGreedyHParams = EpsilonGreedyHParams()


@dataclasses.dataclass(frozen=True)
class RewardNetworkSettings:
    """The reward network. All static."""

    kind: Literal["deep", "radial-basis", "fourier"] = "deep"
    """A perceptron, or theta^T phi (Eq. 1) with one of two kinds of features."""
    inputs: Literal["state-action", "state"] = "state-action"
    """r(s, a), or r(s)."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of each hidden layer of a deep reward."""
    centres: int = 9
    """Radial basis functions along each dimension of the observation."""
    order: int = 3
    """Highest frequency of the Fourier basis, along each dimension of its inputs."""


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
    hot_start: HotStartHParams = HotStartHParams()
    schedule: Schedule = Schedule()
    tabular: TabularSettings = TabularSettings()


class Algorithm(NamedTuple):
    """A method's parts, made for an environment.

    Attributes:
        agent: DDPG.
        learner: of r_D, or None.
        shaping: how r_D joins r_e.
        exploration: the behaviour policy.
        replay: the buffer.
        background: what the learner of r_D samples, or None for one that does not learn.
    """

    agent: DDPG
    learner: RewardLearner | None
    shaping: Shaping
    exploration: Exploration
    replay: Replay
    background: Background | None


def compose(spec: EnvSpec, method: Method, settings: Settings, capacity: int) -> Algorithm:
    """Make a method's parts; `capacity` is the replay's where the settings leave it open.

    Raises:
        ValueError: for parts that do not fit each other.
    """
    schedule, hparams = settings.reward_schedule, settings.reward
    shaping = schedule.shaping or method.shaping
    agent = ddpg.make(spec, settings.agent, networks=networks.make(spec, settings.architecture))
    behaviour = make_exploration(spec, settings.exploration)
    capacity = settings.schedule.replay_capacity or capacity
    buffer = replay.make(spec, capacity)
    samples = None
    if method.learns_reward:
        if method.reward == "maxent":
            _check_weights(settings)
        samples = background.make(
            spec,
            agent.networks,
            behaviour,
            buffer,
            capacity,
            # A discriminator is trained on the pairs as they come.
            schedule
            if method.reward == "maxent"
            else dataclasses.replace(schedule, weights="uniform"),
            objective=hparams.objective if method.reward == "maxent" else "visitation",
            append=hparams.append_demonstrations,
        )
    if method.reward is not None and shaping == "potential":
        _check_potential(method, settings)
    return Algorithm(
        agent=agent,
        learner=make_learner(spec, method, settings, shaping),
        shaping=shaping,
        exploration=behaviour,
        replay=buffer,
        background=samples,
    )


def make_learner(
    spec: EnvSpec, method: Method, settings: Settings, shaping: Shaping
) -> RewardLearner | None:
    """The learner of `method.reward`, or what stands in for one."""
    hparams = settings.reward
    network = reward_network(spec, settings.reward_network, state_only=shaping == "potential")
    match method.reward:
        case "maxent":
            return irl.make(spec, hparams, network=network)
        case "gail":
            return irl.adversarial.make(spec, settings.gail, network=network)
        case "tabular-linear" | "tabular-deep":
            return frozen.make(*imitation.grids(spec, settings.tabular), hparams)
        case "random":
            return irl.controls.random(spec, hparams, network=network)
        case "plus-constant":
            return irl.controls.constant(hparams.bound)
        case "minus-constant":
            return irl.controls.constant(-hparams.bound)
        case None:
            return None


def reward_network(
    spec: EnvSpec, settings: RewardNetworkSettings, *, state_only: bool = False
) -> Network:
    """f(s, a) as the settings say; `state_only` for a potential, whatever they say."""
    inputs = "state" if state_only else settings.inputs
    match settings.kind:
        case "deep":
            return rewards.mlp(spec, settings.hidden, inputs)
        case "radial-basis":
            return rewards.linear(spec, rewards.radial_basis(spec, settings.centres, inputs))
        case "fourier":
            return rewards.linear(spec, rewards.fourier(spec, settings.order, inputs))


def _check_weights(settings: Settings) -> None:
    if settings.exploration.kind != "epsilon-greedy":
        return
    weights, epsilon_greedy = settings.reward_schedule.weights, settings.exploration.epsilon_greedy
    whole = settings.reward.objective == "trajectory"
    if weights != "uniform" and whole and epsilon_greedy.hold > 1:
        raise ValueError(
            "a trajectory of held random actions has no density to weight it by: take "
            "reward_schedule.weights uniform, or exploration.epsilon_greedy.hold 1"
        )
    if epsilon_greedy.noise is None and (weights == "fusion" or (weights != "uniform" and whole)):
        raise ValueError(
            "a greedy action without noise has no density to weight it by: take "
            "reward_schedule.weights uniform, or give exploration.epsilon_greedy.noise"
        )


def _check_potential(method: Method, settings: Settings) -> None:
    if method.tabular is not None and settings.tabular.reward != "state":
        raise ValueError(
            f"a potential is a function of the state: {method.name} needs tabular.reward state"
        )
    if method.reward == "maxent" and settings.reward.absorbing:
        raise ValueError("a potential is 0 past termination: it has no absorbing reward")


def make_exploration(spec: EnvSpec, settings: ExplorationSettings) -> Exploration:
    """The behaviour policy that `settings.kind` names."""
    match settings.kind:
        case "ornstein-uhlenbeck":
            return exploration.ornstein_uhlenbeck(spec, settings.ornstein_uhlenbeck)
        case "gaussian":
            return exploration.gaussian(spec, settings.gaussian)
        case "epsilon-greedy":
            return exploration.epsilon_greedy(spec, settings.epsilon_greedy)
