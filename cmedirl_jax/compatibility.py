"""Which choices do not fit each other: refusals that name the options, before anything is made."""

from cmedirl_jax.exploration import EpsilonGreedyHParams
from cmedirl_jax.methods import Method, Settings
from cmedirl_jax.shaping import Shaping
from cmedirl_jax.types import EnvSpec


def check(
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
        _reward(method, settings, shaping)
    if method.reward == "maxent":
        _samples(spec, settings, capacity)


def _samples(spec: EnvSpec, settings: Settings, capacity: int) -> None:
    """Refuse samples that are not there, and weights by densities that are not."""
    schedule, behaviour = settings.reward_schedule, settings.exploration
    whole, weights = settings.reward.objective == "trajectory", schedule.weights
    if whole and capacity < spec.max_episode_steps:
        raise ValueError(
            f"trajectories need a replay of {spec.max_episode_steps} transitions: take a larger "
            "schedule.replay_capacity"
        )
    if weights == "uniform":
        return
    reach = schedule.snapshots * schedule.snapshot_period
    if weights == "fusion" and (schedule.recent is None or schedule.recent > reach):
        raise ValueError(
            f"the snapshots reach back {reach} steps: take reward_schedule.recent {reach} or less"
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
                    "take exploration.kind gaussian, or reward_schedule.weights recorded"
                )
        case "gaussian":
            if behaviour.gaussian.scale <= 0:
                raise ValueError("noise without a density: take exploration.gaussian.scale above 0")
        case "epsilon-greedy":
            _epsilon_greedy(behaviour.epsilon_greedy, whole=whole, fused=weights == "fusion")


def _epsilon_greedy(hparams: EpsilonGreedyHParams, *, whole: bool, fused: bool) -> None:
    if whole and hparams.hold > 1:
        raise ValueError(
            "a trajectory of held random actions has no density to weight it by: take "
            "reward_schedule.weights uniform, or exploration.epsilon_greedy.hold 1"
        )
    if hparams.noise is None and (whole or fused):
        raise ValueError(
            "a greedy action without noise has no density to weight it by: take "
            "reward_schedule.weights uniform, or give exploration.epsilon_greedy.noise"
        )
    if hparams.noise is not None and hparams.noise <= 0:
        raise ValueError("take exploration.epsilon_greedy.noise above 0, or leave it out")


def _reward(method: Method, settings: Settings, shaping: Shaping) -> None:
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
