"""A method's parts, made for an environment."""

import dataclasses
from typing import NamedTuple

from cmedirl_jax import (
    background,
    checks,
    compatibility,
    ddpg,
    exploration,
    irl,
    networks,
    ranges,
    replay,
    rewards,
)
from cmedirl_jax.background import Background
from cmedirl_jax.ddpg import DDPG
from cmedirl_jax.exploration import Exploration
from cmedirl_jax.irl import RewardLearner
from cmedirl_jax.methods import ExplorationSettings, Method, RewardNetworkSettings, Settings
from cmedirl_jax.replay import Replay
from cmedirl_jax.shaping import Shaping
from cmedirl_jax.tabular import frozen, imitation
from cmedirl_jax.types import EnvSpec, Network


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
        ValueError: for a specification that does not agree with itself, numbers out of their range,
            or parts that do not fit each other.
    """
    checks.env_spec(spec)
    ranges.check(settings)
    schedule, hparams = settings.reward_schedule, settings.reward
    shaping = schedule.shaping or method.shaping
    agent = ddpg.make(spec, settings.agent, networks=networks.make(spec, settings.architecture))
    behaviour = make_exploration(spec, settings.exploration, hot_start=method.hot_start)
    capacity = settings.schedule.replay_capacity or capacity
    buffer = replay.make(spec, capacity)
    compatibility.check(spec, method, settings, shaping, capacity)
    samples = None
    if method.reward == "maxent":
        samples = background.make(
            spec,
            agent.networks,
            behaviour,
            buffer,
            capacity,
            schedule,
            objective=hparams.objective,
            append=hparams.append_demonstrations,
        )
    elif method.learns_reward:
        # A discriminator is trained on the pairs as they come.
        pairs = dataclasses.replace(schedule, weights="uniform")
        samples = background.make(spec, agent.networks, behaviour, buffer, capacity, pairs)
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
