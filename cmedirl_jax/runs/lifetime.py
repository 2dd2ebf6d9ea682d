"""What ends the seeds of a run: environment steps, episodes, or either."""

from typing import Any, NamedTuple

from cmedirl_jax import envs


class Lifetime(NamedTuple):
    """What ends the seeds of a run.

    Attributes:
        steps: the last environment step that a seed can reach.
        episodes: after which every seed ends; None where steps end it.
        mixed: some may end by steps and others by episodes, so that they are not watched for as
            long in either.
    """

    steps: int
    episodes: int | None
    mixed: bool


def lifetime(config: dict[str, Any]) -> Lifetime:
    """What ends the seeds of a run, by its configuration."""
    episodes, steps = config["max_episodes"], config["max_steps"]
    if episodes is None:
        return Lifetime(int(steps), None, False)
    longest = episodes * envs.find(config["env"]).spec.max_episode_steps
    if steps is None or longest <= steps:
        return Lifetime(int(longest), episodes, False)
    return Lifetime(int(steps), None, True)
