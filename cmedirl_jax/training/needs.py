"""What a method reads of its demonstrations: pools that lack it are refused."""

from collections.abc import Sequence

from cmedirl_jax.training.methods import Method
from cmedirl_jax.training.settings import Settings

RETURNS = ("quadratic", "monte-carlo")
"""The losses of the critic's hot start that read returns."""


def check(method: Method, settings: Settings, absent: Sequence[str]) -> None:
    """Refuse demonstrations that lack what a method reads.

    Args:
        method: the method.
        settings: every other choice.
        absent: the fields that the pool lacks, see `demonstrations.absent`.

    Raises:
        ValueError: saying what is read, and which methods or settings do without.
    """
    if "reward" in absent and method.hot_start and settings.hot_start.critic in RETURNS:
        raise ValueError(
            f"{method.name} fits its critic to returns, the demonstrations have no rewards: give "
            "another hot_start.critic"
        )
    if "action" not in absent or not method.uses_demonstrations:
        return
    without = "the demonstrations have no actions; me-ddpg, irl-only and gail do without"
    if method.hot_start:
        raise ValueError(f"{method.name} starts hot from demonstrated actions: {without}")
    if method.tabular is not None:
        raise ValueError(f"{method.name} counts demonstrated actions: {without}")
    if settings.reward_network.inputs != "state":
        raise ValueError(
            f"{method.name} learns r_D(s, a), the demonstrations have no actions: give "
            "reward_network.inputs state"
        )
    if settings.reward_batches.weights == "fusion":
        raise ValueError(
            f"{method.name} fits a density to demonstrated actions, there are none: give other "
            "reward_batches.weights"
        )
