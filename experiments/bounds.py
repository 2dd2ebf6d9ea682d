"""Which numbers a run's options may be."""

from cmedirl_jax import ranges
from cmedirl_jax.ranges import COUNT, NOT_NEGATIVE, SIZE, Range
from experiments.errors import UserError
from experiments.presets import Grid

RANGES: dict[str, Range] = {
    "n_demos": SIZE,
    "seeds": SIZE,
    "seed": Range(0, 2**32 - 1, "between 0 and 2^32 - 1"),
    "max_steps": SIZE,
    "max_episodes": SIZE,
    "evaluate_every": SIZE,
    "evaluation_starts": SIZE,
    "evaluate_every_episodes": SIZE,
    "evaluation_starts_episodes": SIZE,
    "devices": SIZE,
    "group": SIZE,
    "processes": SIZE,
    "process_id": COUNT,
    "checkpoint_every": NOT_NEGATIVE,
    "experts.seeds": SIZE,
    "experts.steps": SIZE,
    "experts.trajectories": SIZE,
    **{f"settings.{name}": of_name for name, of_name in ranges.RANGES.items()},
}
"""Of every number in `Grid`."""


def check(grid: Grid) -> None:
    """Refuse a number out of its range.

    Raises:
        UserError: naming the option, what it must be and what it is.
    """
    for name, wrong in ranges.out_of_range(grid, RANGES):
        option = name.removeprefix("settings.").replace("_", "-")
        raise UserError(f"--{option}: {wrong}")
