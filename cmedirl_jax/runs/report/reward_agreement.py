"""Whether the seeds of a method have learned the same reward."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
import polars as pl

from cmedirl_jax.assess import importance
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.runs.drawing import Figure
from cmedirl_jax.runs.report.reward_samples import Learners, RewardedRun

COMPARED = 2_048
"""Steps of all learners of a method together that two rewards are compared on."""


class Agreement(NamedTuple):
    """The distances between the rewards of a method's learners.

    Attributes:
        learners: whose.
        distance: `[R, R]`.
    """

    learners: Learners
    distance: np.ndarray


def of_run(run: RewardedRun) -> list[Agreement]:
    """The distances between the rewards of each method, on steps of all its learners."""
    found = []
    for learners in run.learners:
        visited, each = learners.visited, -(-COMPARED // len(learners.seeds))
        every = max(1, visited.reward.shape[1] // each)
        steps = jax.tree.map(
            lambda leaf, every=every: leaf[:, ::every].reshape(-1, *leaf.shape[2:]), visited
        )
        distances = jax.jit(
            lambda params, steps, pay=learners.rewards.reward: importance.disagreement(
                Rewards(pay, params), steps
            )
        )
        found.append(Agreement(learners, np.asarray(distances(learners.rewards.params, steps))))
    return found


def rows(found: Sequence[Agreement]) -> pl.DataFrame:
    """The mean distance of each learner's reward to the others': null for a single one."""
    parts = []
    for learners, distance in found:
        others = len(distance) - 1
        total = distance.sum(axis=1) - distance.diagonal()
        mean = total / others if others else np.full(1, np.nan)
        parts.append(learners.table({"disagreement": mean}))
    return pl.concat(parts).with_columns(pl.col("disagreement").fill_nan(None))


def figure(found: Sequence[Agreement]) -> Figure:
    """The distances between the seeds' rewards, a panel for each method."""
    columns = min(4, len(found))
    count = -(-len(found) // columns)
    drawn = Figure(figsize=(2.8 * columns + 0.8, 2.8 * count), layout="constrained")
    panels = list(drawn.subplots(count, columns, squeeze=False).flat)
    for axes, (learners, distance) in zip(panels, found, strict=False):
        axes.imshow(distance, cmap="cividis", vmin=0.0, vmax=1.0, interpolation="nearest")
        axes.set_title(learners.name, fontsize=9)
        axes.set_xlabel("learner", fontsize=8)
        axes.tick_params(labelsize=7)
    for axes in panels[len(found) :]:
        axes.set_axis_off()
    bar = drawn.colorbar(panels[0].images[0], ax=panels)
    bar.set_label("distance (0: equal, 0.71: unrelated)", fontsize=8)
    return drawn
