"""A method's parts, made for an environment."""

import dataclasses
from typing import NamedTuple

from cmedirl_jax import checks, irl, networks, ranges
from cmedirl_jax.agents import ddpg, exploration
from cmedirl_jax.agents.ddpg import DDPG
from cmedirl_jax.agents.exploration import EpsilonGreedyHParams, Exploration
from cmedirl_jax.data import replay
from cmedirl_jax.data.replay import Replay
from cmedirl_jax.irl import RewardLearner, reward_batches, rewards
from cmedirl_jax.irl.reward_batches import RewardSampler
from cmedirl_jax.irl.shaping import Shaping
from cmedirl_jax.tabular import imitation, table_reward
from cmedirl_jax.training.methods import (
    ExplorationSettings,
    Method,
    RewardNetworkSettings,
    Settings,
)
from cmedirl_jax.types import EnvSpec, Network


class Algorithm(NamedTuple):
    """A method's parts, made for an environment.

    Attributes:
        agent: DDPG.
        learner: of r_D, or None.
        shaping: how r_D joins r_e.
        exploration: the behaviour policy.
        replay: the buffer.
        sampler: what the learner of r_D samples, or None for one that does not learn.
    """

    agent: DDPG
    learner: RewardLearner | None
    shaping: Shaping
    exploration: Exploration
    replay: Replay
    sampler: RewardSampler | None


def compose(spec: EnvSpec, method: Method, settings: Settings, capacity: int) -> Algorithm:
    """Make a method's parts; `capacity` is the replay's where the settings leave it open.

    Raises:
        ValueError: for a specification that does not agree with itself, numbers out of their range,
            or parts that do not fit each other.
    """
    checks.env_spec(spec)
    ranges.check(settings)
    hparams = settings.reward
    shaping = settings.reward_schedule.shaping or method.shaping
    agent = ddpg.make(spec, settings.agent, networks=networks.make(spec, settings.architecture))
    behaviour = make_exploration(spec, settings.exploration, hot_start=method.hot_start)
    capacity = settings.schedule.replay_capacity or capacity
    buffer = replay.make(spec, capacity)
    check_compatible(spec, method, settings, shaping, capacity)
    sampler = None
    if method.reward == "maxent":
        sampler = reward_batches.make(
            spec,
            agent.networks,
            behaviour,
            buffer,
            capacity,
            settings.reward_batches,
            objective=hparams.objective,
            append=hparams.append_demonstrations,
        )
    elif method.learns_reward:
        # A discriminator is trained on the pairs as they come.
        pairs = dataclasses.replace(settings.reward_batches, weights="uniform")
        sampler = reward_batches.make(spec, agent.networks, behaviour, buffer, capacity, pairs)
    return Algorithm(
        agent=agent,
        learner=make_learner(spec, method, settings, shaping),
        shaping=shaping,
        exploration=behaviour,
        replay=buffer,
        sampler=sampler,
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
            return irl.gail.make(spec, settings.gail, network=network)
        case "tabular-linear" | "tabular-deep":
            return table_reward.make(*imitation.grids(spec, settings.tabular), hparams)
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


def check_compatible(
    spec: EnvSpec, method: Method, settings: Settings, shaping: Shaping, capacity: int
) -> None:
    """Check a method's settings for learning and using r_D.

    Args:
        spec: the environment's.
        method: the method.
        settings: its settings.
        shaping: how r_D joins r_e, the method's own or the settings'.
        capacity: of the replay.

    Raises:
        ValueError: naming the option that should be another.
    """
    if method.reward is not None:
        _check_reward(method, settings, shaping)
    if method.reward == "maxent":
        _check_samples(spec, settings, capacity)


def _check_samples(spec: EnvSpec, settings: Settings, capacity: int) -> None:
    """Refuse samples that are not there, and weights by densities that are not."""
    batches, behaviour = settings.reward_batches, settings.exploration
    whole, weights = settings.reward.objective == "trajectory", batches.weights
    if whole and capacity < spec.max_episode_steps:
        raise ValueError(
            f"trajectories need a replay of {spec.max_episode_steps} transitions: take a larger "
            "schedule.replay_capacity"
        )
    if weights == "uniform":
        return
    reach = batches.snapshots * batches.snapshot_period
    if weights == "fusion" and (batches.recent is None or batches.recent > reach):
        raise ValueError(
            f"the snapshots reach back {reach} steps: take reward_batches.recent {reach} or less"
        )
    match behaviour.kind:
        case "ornstein-uhlenbeck":
            noise = behaviour.ornstein_uhlenbeck
            if noise.sigma <= 0 or not 0 < noise.theta < 2:
                raise ValueError(
                    "noise without a density: take exploration.ornstein_uhlenbeck.sigma above 0 "
                    "and theta between 0 and 2"
                )
            if whole and weights == "fusion":
                raise ValueError(
                    "what noise another policy would have needed at the step before is not known: "
                    "take exploration.kind gaussian, or reward_batches.weights recorded"
                )
        case "gaussian":
            if behaviour.gaussian.scale <= 0:
                raise ValueError("noise without a density: take exploration.gaussian.scale above 0")
        case "epsilon-greedy":
            _check_epsilon_greedy(behaviour.epsilon_greedy, whole=whole, fused=weights == "fusion")


def _check_epsilon_greedy(hparams: EpsilonGreedyHParams, *, whole: bool, fused: bool) -> None:
    if whole and hparams.hold > 1:
        raise ValueError(
            "a trajectory of held random actions has no density to weight it by: take "
            "reward_batches.weights uniform, or exploration.epsilon_greedy.hold 1"
        )
    if hparams.noise is None and (whole or fused):
        raise ValueError(
            "a greedy action without noise has no density to weight it by: take "
            "reward_batches.weights uniform, or give exploration.epsilon_greedy.noise"
        )
    if hparams.noise is not None and hparams.noise <= 0:
        raise ValueError("take exploration.epsilon_greedy.noise above 0, or leave it out")


def _check_reward(method: Method, settings: Settings, shaping: Shaping) -> None:
    schedule, hparams = settings.reward_schedule, settings.reward
    potential, alone = shaping == "potential", shaping == "alone"
    absorbing = method.reward == "maxent" and hparams.absorbing
    if method.shaping == "alone" and not alone:
        raise ValueError(f"{method.name} is r_D alone: leave reward_schedule.shaping")
    if alone and schedule.anneal_steps is not None:
        raise ValueError("r_D alone must not fade: leave reward_schedule.anneal_steps")
    if potential and method.tabular is not None and settings.tabular.reward != "state":
        raise ValueError("a potential is a function of the state: take tabular.reward state")
    if (potential or absorbing) and settings.agent.bootstrap_at_termination:
        raise ValueError(
            "what ends must not bootstrap: leave agent.bootstrap_at_termination, or take another "
            "reward_schedule.shaping and no reward.absorbing"
        )
    if absorbing and potential:
        raise ValueError(
            "a potential is 0 past termination: leave reward.absorbing, or take another "
            "reward_schedule.shaping"
        )
    if absorbing and settings.agent.discount >= 1.0:
        raise ValueError("an absorbing state for ever needs an agent.discount below 1")
    if absorbing and hparams.bounded_by == "none" and hparams.objective == "visitation":
        raise ValueError(
            "nothing bounds an absorbing state's reward: take another reward.bounded_by"
        )
    if method.reward == "random" and settings.reward_network.kind != "deep":
        raise ValueError("a linear reward starts at zero: take reward_network.kind deep")
