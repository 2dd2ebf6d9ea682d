"""What a benchmark runs: one method on so many seeds, at one size."""

import dataclasses
from typing import Literal

CAPACITY = 12_000
"""Transitions each seed's replay holds: a whole run of the main job."""


@dataclasses.dataclass(frozen=True)
class Workload:
    """A training loop to time. The defaults are the sizes that the project's targets name."""

    variant: Literal["ours", "naive"] = "ours"
    """The library's training loop, or the plain reference."""
    method: str = "ddpg"
    """One of `METHODS`."""
    seeds: int = 100
    """Independent learners."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of each hidden layer of every network."""
    batch: int = 32
    """Transitions per update."""
    layer_norm: bool = False
    """Layer normalisation in the critic."""
    devices: int = 1
    """1: one device on one core; more: so many devices on all cores."""
    n_demos: int = 10
    """Demonstrated trajectories per learner."""
    group: int | None = None
    """Seeds vmapped together; None: the library's choice."""
    running: float = 1.0
    """Share of the seeds that have not ended."""
