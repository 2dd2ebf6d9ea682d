"""How methods are drawn: the same line for each in every figure, bands, levels and legends."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from cmedirl_jax.runs import intervals
from cmedirl_jax.runs.drawing import Axes, Figure
from cmedirl_jax.training.methods import METHODS

# Okabe and Ito's palette, which colour-blind readers can tell apart; wine in place of its yellow,
# which is faint on white.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#882255", "#000000")
STYLES = ("-", "--", "-.", ":")
GREY = {"color": "0.6", "linestyle": "-"}
"""The line of the method that others are drawn beside."""
MOST_CURVES = 5
"""More than these in one panel cannot be told apart: each method gets a panel of its own."""


def band(axes: Axes, rows: pl.DataFrame, x: str, y: str, method: str, line: dict[str, Any]) -> None:
    """The mean of column `y` over the seeds with its 95% interval, over column `x`.

    It ends where the first seed has no more rows: a mean over those left would be over other seeds.
    Seeds that share an expert are resampled together.
    """
    points = rows.group_by(x, maintain_order=True).agg(pl.col(y, "expert_id")).sort(x)
    seeds = rows["seed"].n_unique()
    points = points.filter(pl.col(y).list.len() == seeds)
    bands = np.array(
        [
            intervals.mean(
                values.to_numpy(), clusters=None if experts.null_count() else experts.to_numpy()
            )
            for values, experts in zip(points[y], points["expert_id"], strict=True)
        ]
    )
    if not len(bands):
        return
    if len(bands) == 1:
        # A method that never interacts has the same return at every step.
        axes.axhline(bands[0, 0], color=line["color"], linestyle="-.", label=label(method))
        return
    axes.plot(points[x], bands[:, 0], **line, label=label(method))
    axes.fill_between(
        points[x], bands[:, 1], bands[:, 2], color=line["color"], alpha=0.2, linewidth=0
    )


def levels(axes: Axes, expert: float | None, threshold: float | None) -> None:
    """Lines at the experts' return and at the threshold."""
    if expert is not None:
        axes.axhline(expert, color="0.4", linestyle="--", linewidth=1, label="experts")
    if threshold is not None:
        axes.axhline(threshold, color="0.7", linestyle=":", linewidth=1, label="solved")


def panels(methods: Iterable[str]) -> tuple[Figure, dict[str, Axes]]:
    """A figure with a titled panel for each method, with shared axes."""
    methods = list(methods)
    columns = 4
    rows = -(-len(methods) // columns)
    figure = Figure(figsize=(11, 2.4 * rows), layout="constrained")
    every = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    for axes in every[len(methods) :]:
        axes.set_axis_off()
    found = dict(zip(methods, every, strict=False))
    for method, axes in found.items():
        axes.set_title(label(method), fontsize=10)
    return figure, found


def label(method: str) -> str:
    """What a method is called in figures."""
    return (METHODS[method].label if method in METHODS else None) or method


def legend(figure: Figure, axes: Axes, columns: int = 3) -> None:
    """One legend for the figure, below it, where it hides nothing.

    Args:
        figure: the figure.
        axes: whose curves it names.
        columns: at most so many for each panel of the figure.
    """
    handles, labels = axes.get_legend_handles_labels()
    columns = min(len(labels), columns * len(figure.axes))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)


class Over(NamedTuple):
    """What evaluations are drawn over.

    Attributes:
        rows: of evaluations.parquet.
        column: of the horizontal axis.
        label: of it.
    """

    rows: pl.DataFrame
    column: str
    label: str


def over(evaluations: pl.DataFrame, by_episodes: bool) -> Over:
    """Evaluations over the unit in which all seeds live as long: steps, or episodes.

    Seeds are evaluated at the end of the chunk in which they finish so many episodes: each one's
    n-th evaluation is drawn at the median of their numbers of episodes.
    """
    of_episodes = evaluations.filter(
        (pl.col("protocol") == "episodes") | (pl.col("env_step") == 0), pl.col("protocol") != "soft"
    )
    if by_episodes and of_episodes["env_step"].max():
        order = pl.int_range(pl.len()).over("method", "n_demos", "seed", order_by="env_step")
        episode = pl.col("episode").cast(pl.Float64).median().over("order")
        rows = of_episodes.with_columns(order=order).with_columns(episode=episode)
        return Over(rows, "episode", "episodes")
    by_steps = evaluations.filter(pl.col("protocol") == "steps")
    return Over(by_steps, "env_step", "environment steps")


def lines(methods: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Each method's line: the same colour and style in every figure, told apart in grey too."""
    methods = list(dict.fromkeys(methods))
    order = [*METHODS, *sorted(set(methods) - set(METHODS))]
    found = {}
    for method in methods:
        index = order.index(method)
        style = STYLES[(index + index // len(COLOURS)) % len(STYLES)]
        found[method] = {"color": COLOURS[index % len(COLOURS)], "linestyle": style}
    return found
