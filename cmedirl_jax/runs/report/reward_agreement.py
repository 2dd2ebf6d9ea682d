"""Whether the seeds of a method have learned the same reward."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
import polars as pl

from cmedirl_jax.assess import importance
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.runs.drawing import Figure
from cmedirl_jax.runs.report import curves
from cmedirl_jax.runs.report.reward_samples import Judged
from cmedirl_jax.runs.storage.cells import CellKey

COMPARED = 2_048
"""Steps of all learners together that two rewards are compared on."""


class Agreement(NamedTuple):
    """The distances between a cell's rewards.

    Attributes:
        key: the cell's.
        distance: `[seeds, seeds]`.
    """

    key: CellKey
    distance: np.ndarray


def of_run(judged: Judged) -> list[Agreement]:
    """The distances between the rewards of each cell, on steps of all its learners."""
    found = []
    for cell, sampled in judged.cells:
        rewards, visited = Rewards(*cell.rewards()), sampled.visited
        each = -(-COMPARED // cell.cell.key.seeds)
        steps = jax.tree.map(
            lambda leaf, each=each: leaf[:, :: max(1, leaf.shape[1] // each)].reshape(
                -1, *leaf.shape[2:]
            ),
            visited,
        )
        distances = jax.jit(
            lambda params, steps, pay=rewards.reward: importance.disagreement(
                Rewards(pay, params), steps
            )
        )
        found.append(Agreement(cell.cell.key, np.asarray(distances(rewards.params, steps))))
    return found


def rows(found: Sequence[Agreement]) -> pl.DataFrame:
    """The mean distance of each learner's reward to the others': null for a single one."""
    parts = []
    for key, distance in found:
        others = key.seeds - 1
        own = np.trace(distance) / key.seeds if others else 0.0
        mean = (distance.sum(axis=1) - own) / others if others else [None] * key.seeds
        parts.append(
            pl.DataFrame(
                {
                    "method": [key.method] * key.seeds,
                    "n_demos": [key.n_demos] * key.seeds,
                    "seed": list(key.seed_range),
                    "disagreement": pl.Series(mean, dtype=pl.Float64),
                }
            )
        )
    return pl.concat(parts)


def figure(found: Sequence[Agreement]) -> Figure:
    """The distances between the seeds' rewards, a panel for each cell."""
    columns = min(4, len(found))
    count = -(-len(found) // columns)
    drawn = Figure(figsize=(2.8 * columns + 0.8, 2.8 * count), layout="constrained")
    panels = list(drawn.subplots(count, columns, squeeze=False).flat)
    for axes, (key, distance) in zip(panels, found, strict=False):
        axes.imshow(distance, cmap="cividis", vmin=0.0, vmax=1.0, interpolation="nearest")
        axes.set_title(f"{curves.label(key.method)}, $N_T$ = {key.n_demos}", fontsize=9)
        axes.set_xlabel("seed", fontsize=8)
        axes.tick_params(labelsize=7)
    for axes in panels[len(found) :]:
        axes.set_axis_off()
    bar = drawn.colorbar(panels[0].images[0], ax=panels)
    bar.set_label("distance (0: equal, 0.71: unrelated)", fontsize=8)
    return drawn
