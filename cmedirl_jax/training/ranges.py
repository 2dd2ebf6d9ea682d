"""Which values the numbers of the settings may take, by dotted name."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from cmedirl_jax.training.methods import Settings

_FLOAT = np.finfo(np.float32)


class Range(NamedTuple):
    """A closed interval, in which NaN does not lie.

    Attributes:
        low: the least value.
        high: the largest value.
        words: what a value must be, after "must be".
        too_large: said in place of `words` of a value above `high`.
    """

    low: float
    high: float
    words: str
    too_large: str | None = None


# The library counts in 32 bits and computes in 32-bit floats, whose infinity begins at 3.4e38.
_LARGEST = 2**31 - 1
COUNT = Range(0, _LARGEST, "at least 0", "at most 2^31 - 1")
SIZE = Range(1, _LARGEST, "at least 1", "at most 2^31 - 1")
TWO_OR_MORE = Range(2, _LARGEST, "at least 2", "at most 2^31 - 1")
NOT_NEGATIVE = Range(0.0, float(_FLOAT.max), "at least 0 and finite")
POSITIVE = Range(float(_FLOAT.tiny), float(_FLOAT.max), "positive and finite")
STEPS = Range(1.0, float(_FLOAT.max), "at least 1 and finite")
SHARE = Range(0.0, 1.0, "between 0 and 1")
POSITIVE_SHARE = Range(float(_FLOAT.tiny), 1.0, "above 0 and at most 1")
BELOW_ONE = Range(0.0, 1.0 - float(_FLOAT.epsneg), "at least 0 and below 1")

RANGES: dict[str, Range] = {
    "architecture.hidden": SIZE,
    "architecture.action_layer": COUNT,
    "architecture.output_scale": NOT_NEGATIVE,
    "agent.discount": SHARE,
    "agent.tau": POSITIVE_SHARE,
    "agent.actor_learning_rate": NOT_NEGATIVE,
    "agent.critic_learning_rate": NOT_NEGATIVE,
    "agent.reward_scale": POSITIVE,
    "agent.pre_activation_penalty": NOT_NEGATIVE,
    "agent.behaviour_cloning": NOT_NEGATIVE,
    "exploration.hot_start_factor": POSITIVE,
    # Past 2 the noise grows without end.
    "exploration.ornstein_uhlenbeck.theta": Range(0.0, 2.0, "between 0 and 2"),
    "exploration.ornstein_uhlenbeck.sigma": NOT_NEGATIVE,
    "exploration.gaussian.scale": NOT_NEGATIVE,
    "exploration.epsilon_greedy.epsilon_start": SHARE,
    "exploration.epsilon_greedy.epsilon_end": SHARE,
    "exploration.epsilon_greedy.epsilon_steps": STEPS,
    "exploration.epsilon_greedy.hold": STEPS,
    "exploration.epsilon_greedy.noise": POSITIVE,
    "reward.learning_rate": NOT_NEGATIVE,
    "reward.bound": POSITIVE._replace(
        words="positive and finite (for an unbounded reward take reward.bounded_by none)"
    ),
    "reward.output_penalty": NOT_NEGATIVE,
    "reward.prior_precision": NOT_NEGATIVE,
    "reward.gradient_penalty": NOT_NEGATIVE,
    "reward.gradient_penalty_target": NOT_NEGATIVE,
    "reward.gauge_rate": SHARE,
    "reward.discount": SHARE,
    "reward.weight_exponent": NOT_NEGATIVE,
    "reward.weight_limit": NOT_NEGATIVE,
    "gail.learning_rate": NOT_NEGATIVE,
    "gail.scale": POSITIVE,
    "gail.output_penalty": NOT_NEGATIVE,
    "reward_network.hidden": SIZE,
    "reward_network.centres": TWO_OR_MORE,
    "reward_network.order": SIZE,
    "reward_schedule.period": SIZE,
    "reward_schedule.iterations": SIZE,
    "reward_schedule.stop": COUNT,
    "reward_schedule.anneal_steps": SIZE,
    "reward_batches.batch_size": SIZE,
    "reward_batches.recent": SIZE,
    "reward_batches.snapshots": SIZE,
    "reward_batches.snapshot_period": SIZE,
    "reward_batches.trajectories": SIZE,
    "reward_batches.episodes": SIZE,
    "hot_start.learning_rate": NOT_NEGATIVE,
    "hot_start.curvature": NOT_NEGATIVE,
    "hot_start.margin": NOT_NEGATIVE,
    "hot_start.cells": SIZE,
    "hot_start.steps": SIZE,
    "hot_start.batch_size": SIZE,
    "schedule.batch_size": SIZE,
    "schedule.replay_capacity": SIZE,
    "schedule.learning_starts": COUNT,
    "schedule.update_period": SIZE,
    "schedule.target_period": SIZE,
    "schedule.frozen_actor_steps": COUNT,
    "schedule.behaviour_cloning_steps": SIZE,
    "tabular.states": TWO_OR_MORE,
    "tabular.actions": TWO_OR_MORE,
    "tabular.subsamples": SIZE,
    "tabular.discount": BELOW_ONE,
    "tabular.temperature": POSITIVE,
    "tabular.prior_precision": NOT_NEGATIVE,
    "tabular.steps": SIZE,
    "tabular.centres": TWO_OR_MORE,
    "tabular.hidden": SIZE,
    "tabular.linear_learning_rate": NOT_NEGATIVE,
    "tabular.deep_learning_rate": NOT_NEGATIVE,
}
"""Of every number in `Settings`; of a tuple, each of its numbers."""


def check(settings: Settings) -> None:
    """Refuse settings out of range. Traced numbers and arrays pass: their values are not known.

    Raises:
        ValueError: naming the first such number, what it must be and what it is.
    """
    for name, wrong in out_of_range(settings, RANGES):
        raise ValueError(f"{name} {wrong}")


def out_of_range(options: Any, ranges: Mapping[str, Range]) -> Iterator[tuple[str, str]]:
    """The dotted name of each number of a dataclass that is out of its range, and what is wrong."""
    for name, value in _numbers(options):
        low, high, words, too_large = ranges[name]
        if not low <= value <= high:
            words = too_large if too_large is not None and value > high else words
            yield name, f"must be {words}, got {value}"


def _numbers(options: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    for field in dataclasses.fields(options):
        name, value = prefix + field.name, getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, f"{name}.")
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float | np.number) and not isinstance(number, bool):
                yield name, number  # type: ignore[misc]
