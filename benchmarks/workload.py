"""What a benchmark runs: one method, a number of seeds, one size."""

import dataclasses
from typing import Literal

CAPACITY = 12_000
"""Transitions each seed's replay holds: a whole run of the main job."""


@dataclasses.dataclass(frozen=True)
class Workload:
    """A training loop to time. The defaults are the sizes of the quoted rates.

    Attributes:
        variant: The library's training loop, or the plain reference.
        method: One of `METHODS`.
        seeds: Independent learners.
        hidden: Units of each hidden layer of every network.
        batch: Transitions per update.
        layer_norm: Layer normalisation in the critic.
        devices: 1 is one device on one core; more are that many devices on all cores.
        n_demos: Demonstrated trajectories per learner.
        group: Seeds vmapped together; None: the library's choice.
        running: Share of the seeds that have not ended.
    """

    variant: Literal["ours", "naive"] = "ours"
    method: str = "ddpg"
    seeds: int = 100
    hidden: tuple[int, ...] = (64, 64)
    batch: int = 32
    layer_norm: bool = False
    devices: int = 1
    n_demos: int = 10
    group: int | None = None
    running: float = 1.0
