"""Where r_D comes from: `REWARDS` maps each name to all that belongs to it.

A source learns while DDPG learns, is fitted beforehand by dynamic programming, or is a control that
says nothing of the task. A new source is an entry here; settings of its own are a field of
`RewardSettings`.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

from cmedirl_jax import irl
from cmedirl_jax.agents import exploration
from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.agents.exploration import ExplorationSettings
from cmedirl_jax.irl import GAILHParams, IRLHParams, RewardLearner
from cmedirl_jax.irl.controls import ControlSettings
from cmedirl_jax.irl.objectives import OBJECTIVES, ObjectiveName
from cmedirl_jax.irl.reward_batches import RewardBatchSettings
from cmedirl_jax.irl.rewards import NETWORKS, RewardNetworkSettings
from cmedirl_jax.irl.shaping import Shaping
from cmedirl_jax.registries import Registry
from cmedirl_jax.tabular import imitation, table_reward
from cmedirl_jax.tabular.imitation import TabularSettings
from cmedirl_jax.types import EnvSpec, Network


@dataclasses.dataclass(frozen=True)
class RewardSettings:
    """The settings that sources of rewards read.

    Attributes:
        reward: the learner of "maxent"; its bound is every other source's too, but for "gail".
        gail: the discriminator.
        reward_network: f(s, a), before any bound.
        reward_batches: which samples a learned reward learns from.
        tabular: the grid and the fit of a reward by dynamic programming.
        controls: rewards without information.
    """

    reward: IRLHParams = IRLHParams()
    gail: GAILHParams = GAILHParams()
    reward_network: RewardNetworkSettings = RewardNetworkSettings()
    reward_batches: RewardBatchSettings = RewardBatchSettings()
    tabular: TabularSettings = TabularSettings()
    controls: ControlSettings = ControlSettings()


class RewardUse(NamedTuple):
    """What a method does with r_D.

    Attributes:
        shaping: how r_D joins r_e.
        agent: the hyperparameters of the agent that learns from it.
        exploration: the behaviour policy.
        capacity: transitions that the replay holds.
    """

    shaping: Shaping
    agent: DDPGHParams
    exploration: ExplorationSettings
    capacity: int


class Sampling(NamedTuple):
    """How a source samples while it learns.

    Attributes:
        batches: how many samples, and their weights.
        objective: whose samples they are: pairs or trajectories.
        append: whether the demonstrations join the background.
        draws: an update draws random numbers of its own.
    """

    batches: RewardBatchSettings
    objective: ObjectiveName = "visitation"
    append: bool = True
    draws: bool = False


def _accept(spec: EnvSpec, settings: RewardSettings, use: RewardUse) -> None:
    del spec, settings, use


class RewardSource(NamedTuple):
    """All that belongs to the name of a source of r_D.

    Attributes:
        make: `(spec, settings, network) -> RewardLearner`; `network` is f(s, a), or f(s) for a
            potential.
        sampling: `settings -> Sampling` of a source that learns while DDPG learns; None for one
            that does not.
        tabular: kind of a reward that dynamic programming fits beforehand; None for others.
        check: `(spec, settings, use)`, raises ValueError naming the option that does not fit.
    """

    make: Callable[[EnvSpec, RewardSettings, Network], RewardLearner]
    sampling: Callable[[RewardSettings], Sampling] | None = None
    tabular: imitation.Kind | None = None
    check: Callable[[EnvSpec, RewardSettings, RewardUse], None] = _accept


def _sample_maxent(settings: RewardSettings) -> Sampling:
    hparams = settings.reward
    return Sampling(
        settings.reward_batches,
        hparams.objective,
        append=hparams.append_demonstrations,
        draws=hparams.gradient_penalty is not None,
    )


def _sample_gail(settings: RewardSettings) -> Sampling:
    # A discriminator is trained on the pairs as they come.
    return Sampling(dataclasses.replace(settings.reward_batches, weights="uniform"))


def _make_table(spec: EnvSpec, settings: RewardSettings, network: Network) -> RewardLearner:
    del network
    return table_reward.make(*imitation.grids(spec, settings.tabular), settings.reward)


def _check_maxent(spec: EnvSpec, settings: RewardSettings, use: RewardUse) -> None:
    _check_absorbing(settings, use)
    _check_samples(spec, settings, use)


def _check_absorbing(settings: RewardSettings, use: RewardUse) -> None:
    """Refuse an absorbing state that the rest does not go together with."""
    hparams = settings.reward
    if not hparams.absorbing:
        return
    if use.agent.bootstrap_at_termination:
        raise ValueError(
            "an absorbing state follows termination: leave agent.bootstrap_at_termination, or "
            "reward.absorbing"
        )
    if use.shaping == "potential":
        raise ValueError(
            "a potential is 0 past termination: leave reward.absorbing, or take another "
            "reward_schedule.shaping"
        )
    if use.agent.discount >= 1.0:
        raise ValueError("an absorbing state for ever needs an agent.discount below 1")
    if OBJECTIVES[hparams.objective].needs_bound and hparams.bounded_by == "none":
        raise ValueError(
            "nothing bounds an absorbing state's reward: take another reward.bounded_by"
        )


def _check_samples(spec: EnvSpec, settings: RewardSettings, use: RewardUse) -> None:
    """Refuse samples that are not there, and weights by densities that are not."""
    batches, weights = settings.reward_batches, settings.reward_batches.weights
    trajectories = OBJECTIVES[settings.reward.objective].trajectories
    if trajectories and use.capacity < spec.max_episode_steps:
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
        use.exploration, trajectories=trajectories, mixture=weights == "fusion"
    )


def _check_table(spec: EnvSpec, settings: RewardSettings, use: RewardUse) -> None:
    del spec
    if use.shaping == "potential" and settings.tabular.reward != "state":
        raise ValueError("a potential is a function of the state: take tabular.reward state")


def _check_random(spec: EnvSpec, settings: RewardSettings, use: RewardUse) -> None:
    del spec, use
    if NETWORKS[settings.reward_network.kind].starts_at_zero:
        raise ValueError("a linear reward starts at zero: take reward_network.kind deep")


REWARDS: Registry[RewardSource] = Registry(
    "source of rewards",
    {
        # Learned from samples (Algorithm 1).
        "maxent": RewardSource(
            lambda spec, settings, network: irl.make(spec, settings.reward, network=network),
            sampling=_sample_maxent,
            check=_check_maxent,
        ),
        # From a discriminator.
        "gail": RewardSource(
            lambda spec, settings, network: irl.gail.make(spec, settings.gail, network=network),
            sampling=_sample_gail,
        ),
        # Frozen, by dynamic programming on a grid of the environment (Eqs. 6-9).
        "tabular-linear": RewardSource(_make_table, tabular="linear", check=_check_table),
        "tabular-deep": RewardSource(_make_table, tabular="deep", check=_check_table),
        # Controls: a frozen random network, and the bound of "maxent" everywhere.
        "random": RewardSource(
            lambda spec, settings, network: irl.controls.random(
                spec,
                settings.reward,
                share=settings.controls.random_share,
                network=network,
            ),
            check=_check_random,
        ),
        "plus-constant": RewardSource(
            lambda spec, settings, network: irl.controls.constant(settings.reward.bound)
        ),
        "minus-constant": RewardSource(
            lambda spec, settings, network: irl.controls.constant(-settings.reward.bound)
        ),
    },
)
"""Maps each name to its source of rewards."""
