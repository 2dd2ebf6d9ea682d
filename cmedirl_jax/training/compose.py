"""A method's parts, made for an environment."""

from typing import NamedTuple

from cmedirl_jax import checks, networks, ranges
from cmedirl_jax.agents import ddpg, exploration
from cmedirl_jax.agents.ddpg import DDPG
from cmedirl_jax.agents.exploration import Exploration
from cmedirl_jax.data import replay
from cmedirl_jax.data.replay import Replay
from cmedirl_jax.irl import RewardLearner, reward_batches, rewards
from cmedirl_jax.irl.reward_batches import RewardSampler
from cmedirl_jax.irl.shaping import Shaping
from cmedirl_jax.training.methods import Method
from cmedirl_jax.training.reward_sources import RewardUse
from cmedirl_jax.training.settings import Settings
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
        reward_draws: an update of r_D draws random numbers of its own (static).
    """

    agent: DDPG
    learner: RewardLearner | None
    shaping: Shaping
    exploration: Exploration
    replay: Replay
    sampler: RewardSampler | None
    reward_draws: bool


def compose(spec: EnvSpec, method: Method, settings: Settings, capacity: int) -> Algorithm:
    """Make a method's parts; `capacity` is the replay's where the settings leave it open.

    Raises:
        ValueError: for a specification that does not agree with itself, numbers out of their range,
            an unknown name, or parts that do not fit each other.
    """
    checks.env_spec(spec)
    ranges.check(settings)
    shaping = settings.reward_schedule.shaping or method.shaping
    capacity = settings.schedule.replay_capacity or capacity
    source = method.source
    if source is not None:
        _check_shaping(method, settings, shaping)
        use = RewardUse(shaping, settings.agent, settings.exploration, capacity)
        source.check(spec, settings, use)

    agent = ddpg.make(spec, settings.agent, networks=networks.make(spec, settings.architecture))
    behaviour = exploration.make(spec, settings.exploration, hot_start=method.hot_start)
    buffer = replay.make(spec, capacity)

    learner, sampler, draws = None, None, False
    if source is not None:
        network = rewards.make(
            spec,
            settings.reward_network,
            state_only=shaping == "potential",
            normalise=settings.architecture.normalise_observation,
        )
        learner = source.make(spec, settings, network)
    if source is not None and source.sampling is not None:
        batches, objective, append, draws = source.sampling(settings)
        sampler = reward_batches.make(
            spec,
            agent.networks,
            behaviour,
            buffer,
            capacity,
            batches,
            objective=objective,
            append=append,
        )
    return Algorithm(agent, learner, shaping, behaviour, buffer, sampler, draws)


def _check_shaping(method: Method, settings: Settings, shaping: Shaping) -> None:
    """Refuse a way of joining r_D to r_e that does not fit the method or the agent.

    Raises:
        ValueError: naming the option that should be another.
    """
    if method.shaping == "alone" and shaping != "alone":
        raise ValueError(f"{method.name} is r_D alone: leave reward_schedule.shaping")
    if shaping == "alone" and settings.reward_schedule.anneal_steps is not None:
        raise ValueError("r_D alone must not fade: leave reward_schedule.anneal_steps")
    if shaping == "potential" and settings.agent.bootstrap_at_termination:
        raise ValueError(
            "a potential is 0 past termination: leave agent.bootstrap_at_termination, or take "
            "another reward_schedule.shaping"
        )
