"""A method's parts, made for an environment."""

import dataclasses
from typing import NamedTuple

from cmedirl_jax import checks, irl, networks, ranges
from cmedirl_jax.agents import ddpg, exploration
from cmedirl_jax.agents.ddpg import DDPG
from cmedirl_jax.agents.exploration import Exploration
from cmedirl_jax.data import replay
from cmedirl_jax.data.replay import Replay
from cmedirl_jax.irl import RewardLearner, reward_batches, rewards
from cmedirl_jax.irl.objectives import OBJECTIVES
from cmedirl_jax.irl.reward_batches import RewardSampler
from cmedirl_jax.irl.rewards import NETWORKS
from cmedirl_jax.irl.shaping import Shaping
from cmedirl_jax.tabular import imitation, table_reward
from cmedirl_jax.training.methods import Method, Settings
from cmedirl_jax.types import EnvSpec


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
    behaviour = exploration.make(spec, settings.exploration, hot_start=method.hot_start)
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
    network = rewards.make(spec, settings.reward_network, state_only=shaping == "potential")
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
    batches, weights = settings.reward_batches, settings.reward_batches.weights
    trajectories = OBJECTIVES[settings.reward.objective].trajectories
    if trajectories and capacity < spec.max_episode_steps:
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
    exploration.check_density(
        settings.exploration, trajectories=trajectories, mixture=weights == "fusion"
    )


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
    needs_bound = OBJECTIVES[hparams.objective].needs_bound
    if absorbing and needs_bound and hparams.bounded_by == "none":
        raise ValueError(
            "nothing bounds an absorbing state's reward: take another reward.bounded_by"
        )
    if method.reward == "random" and NETWORKS[settings.reward_network.kind].starts_at_zero:
        raise ValueError("a linear reward starts at zero: take reward_network.kind deep")
