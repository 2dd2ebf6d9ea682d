"""Figures of how the seeds of each method spread: when they arrive, and how far they get."""

from typing import Any, NamedTuple

import numpy as np
import polars as pl

from cmedirl_jax.runs import intervals, statistics
from cmedirl_jax.runs.drawing import Axes, Figure
from cmedirl_jax.runs.report import curves
from cmedirl_jax.runs.statistics import SeedStatistics


def survival(found: dict[str, SeedStatistics], last: float, by_episodes: bool) -> Figure:
    """The share of seeds that have not solved the task yet, over steps or episodes.

    Args:
        found: statistics of each method's seeds.
        last: the step, or episode, at which the first seed ends; later ones are not drawn.
        by_episodes: whether the seeds all end at one episode, rather than at one step.
    """
    unit = "episodes" if by_episodes else "environment steps"
    times = {
        method: one.convergence_episode if by_episodes else one.convergence_env_step
        for method, one in found.items()
    }
    arrivals = {method: np.where(one <= last, one, np.inf) for method, one in times.items()}
    first = next(iter(arrivals), "")
    labels = {
        method: curves.label(method) + ("" if method == first else _p_value(times, arrivals[first]))
        for method, times in arrivals.items()
    }
    steps = {method: _left(times, last) for method, times in arrivals.items()}
    figure = _steps(steps, labels, unit, "share of seeds not solved yet")
    title = "Kaplan-Meier curves, with pointwise 95% intervals"
    if len(arrivals) > 1:
        title += f"\np: log-rank test against {curves.label(first)}, ignores pairing"
    figure.suptitle(title, fontsize=10)
    return figure


class _Steps(NamedTuple):
    """A step function with its band, arrays `[points]`."""

    at: np.ndarray
    share: np.ndarray
    low: np.ndarray
    high: np.ndarray


def _left(times: np.ndarray, last: float) -> _Steps:
    left = intervals.survival(times)
    return _Steps(
        np.r_[0.0, left.time, last],
        *(np.r_[1.0, x, x[-1]] for x in (left.share, left.low, left.high)),
    )


def _p_value(times: np.ndarray, reference: np.ndarray) -> str:
    found = intervals.logrank(times, reference)
    return ", p < 0.001" if found < 0.001 else f", p = {found:.3f}"


def _steps(steps: dict[str, _Steps], labels: dict[str, str], xlabel: str, ylabel: str) -> Figure:
    """Step functions in one panel, or in a panel each beside the first one."""
    lines = curves.lines(steps)
    first = next(iter(steps), "")
    if len(steps) <= curves.MOST_CURVES:
        figure = Figure(figsize=(6.5, 4.3), layout="constrained")
        axes = figure.subplots()
        for method, one in steps.items():
            _draw(axes, one, lines[method], labels[method])
        axes.set(xlabel=xlabel, ylabel=ylabel, ylim=(-0.02, 1.02))
        curves.legend(figure, axes, columns=2)
        return figure
    figure, panels = curves.panels(steps)
    for method, axes in panels.items():
        if method != first:
            _draw(axes, steps[first], curves.GREY, labels[first])
        _draw(axes, steps[method], lines[method] | {"linestyle": "-"}, labels[method])
        axes.set_title(labels[method], fontsize=10)
        axes.set(ylim=(-0.02, 1.02))
    figure.supxlabel(xlabel, fontsize=10)
    figure.supylabel(ylabel, fontsize=10)
    return figure


def _draw(axes: Axes, steps: _Steps, line: dict[str, Any], label: str) -> None:
    axes.step(steps.at, steps.share, where="post", **line, label=label)
    axes.fill_between(
        steps.at, steps.low, steps.high, step="post", color=line["color"], alpha=0.15, linewidth=0
    )


def profile(found: dict[str, SeedStatistics]) -> Figure:
    """Performance profiles (Agarwal et al. 2021): how many seeds return more than each score.

    Args:
        found: statistics of each method's seeds.
    """
    values = {method: np.sort(one.area) for method, one in found.items()}
    ends = np.concatenate([[], *values.values()])
    steps = {}
    for method, one in values.items():
        at = np.r_[ends.min() - 1.0, one, ends.max()]
        bounds = np.array([intervals.share(one > score) for score in at])
        steps[method] = _Steps(at, *bounds.T)
    labels = {method: curves.label(method) for method in values}
    figure = _steps(
        steps, labels, "mean return of all evaluations", "share of seeds that return more"
    )
    figure.suptitle("Performance profiles, with pointwise 95% intervals", fontsize=10)
    return figure


def of_methods(
    evaluations: pl.DataFrame, seeds: pl.DataFrame, threshold: float, by_episodes: bool
) -> dict[str, SeedStatistics]:
    """Statistics of the seeds of each method that acts in the task.

    Args:
        evaluations: of one number of demonstrations a method.
        seeds: of the same cells.
        threshold: return that counts as solved.
        by_episodes: as for `statistics.of_seeds`.
    """
    cells = evaluations.partition_by("method", as_dict=True, maintain_order=True)
    return {
        str(method): statistics.of_seeds(
            rows,
            seeds.filter(pl.col("method") == method).sort("seed")["diverged"].to_numpy(),
            threshold,
            by_episodes=by_episodes,
        )
        for (method,), rows in cells.items()
        if rows["env_step"].max() != 0
    }
