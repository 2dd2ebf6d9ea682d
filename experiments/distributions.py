"""Figures of how the seeds of each method spread: when they arrive, and how far they get."""

from collections.abc import Callable

import numpy as np
import polars as pl

from cmedirl_jax.runs import intervals, statistics
from cmedirl_jax.runs.drawing import Axes, Figure
from cmedirl_jax.runs.statistics import SeedStatistics
from cmedirl_jax.training.methods import METHODS
from experiments import curves


def survival(found: dict[str, SeedStatistics], last: float, by_episodes: bool) -> Figure:
    """The share of seeds that have not solved the task yet, over steps or episodes.

    Args:
        found: statistics of each method's seeds.
        last: the step, or episode, at which all seeds end.
        by_episodes: whether the seeds all end at one episode, rather than at one step.
    """
    figure = Figure(figsize=(6.5, 4.3), layout="constrained")
    axes = figure.subplots()
    arrivals = {
        method: one.convergence_episode if by_episodes else one.convergence_env_step
        for method, one in found.items()
    }
    lines = curves.lines(found)
    first = next(iter(arrivals), "")
    for method, times in arrivals.items():
        left = intervals.survival(times)
        at = np.r_[0.0, left.time, last]
        share, low, high = (np.r_[1.0, x, x[-1]] for x in (left.share, left.low, left.high))
        label = METHODS[method].label or method
        if method != first:
            p_value = intervals.logrank(times, arrivals[first])
            label += ", p < 0.001" if p_value < 0.001 else f", p = {p_value:.3f}"
        line = lines[method]
        axes.step(at, share, where="post", **line, label=label)
        axes.fill_between(at, low, high, step="post", color=line["color"], alpha=0.15, linewidth=0)
    unit = "episodes" if by_episodes else "environment steps"
    axes.set(xlabel=unit, ylabel="share of seeds not solved yet", ylim=(-0.02, 1.02))
    curves.legend(figure, axes)
    title = "Kaplan-Meier curves, with pointwise 95% intervals"
    if len(arrivals) > 1:
        title += f"\np: log-rank test against {METHODS[first].label or first}, ignores pairing"
    figure.suptitle(title, fontsize=10)
    return figure


def profile(found: dict[str, SeedStatistics]) -> Figure:
    """Performance profiles (Agarwal et al. 2021): how many seeds return more than each score.

    Args:
        found: statistics of each method's seeds.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    lines = curves.lines(found)
    scores: tuple[tuple[Axes, str, Callable[[SeedStatistics], np.ndarray]], ...] = (
        (left, "mean return of all evaluations", lambda one: one.area),
        (right, "return of the last evaluation", lambda one: one.final_return),
    )
    for axes, title, of in scores:
        values = {method: np.sort(of(one)) for method, one in found.items()}
        ends = np.concatenate([[], *values.values()])
        for method, one in values.items():
            at = np.r_[ends.min() - 1.0, one, ends.max()]
            bounds = np.array([intervals.share(one > score) for score in at])
            line = lines[method] | {"label": METHODS[method].label or method}
            axes.step(at, bounds[:, 0], where="post", **line)
            axes.fill_between(
                at,
                bounds[:, 1],
                bounds[:, 2],
                step="post",
                color=line["color"],
                alpha=0.15,
                linewidth=0,
            )
        axes.set(xlabel=title)
    left.set(ylabel="share of seeds that return more", ylim=(-0.02, 1.02))
    curves.legend(figure, left)
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
