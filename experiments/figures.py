"""The figures of a run: the paper's 3, 4 and 5, survival, the critic's stability and the cost."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl

from cmedirl_jax.runs import drawing, intervals, statistics
from cmedirl_jax.runs.console import streams
from cmedirl_jax.runs.drawing import Axes, Figure
from cmedirl_jax.training.methods import METHODS
from experiments import curves

MOST_CURVES = 5
"""More than these in one panel cannot be told apart: each method gets a panel of its own."""


def draw(
    folder: Path,
    evaluations: pl.DataFrame,
    episodes: pl.DataFrame,
    seeds: pl.DataFrame,
    summary: pl.DataFrame,
    threshold: float,
    say: Callable[[str], None] = streams.complain,
) -> list[Path]:
    """Draw what the run's cells allow into `folder`, as PNG and SVG.

    Args:
        folder: made if it is missing.
        evaluations: the run's table.
        episodes: the run's table.
        seeds: the run's table.
        summary: a row for each cell.
        threshold: return that counts as solved.
        say: called with a line for each figure that cannot be drawn; the others are drawn.

    Returns:
        The files that were written.
    """
    largest = pl.col("n_demos").is_in([0, max(evaluations["n_demos"])])
    shown = evaluations.filter(largest)
    # The same starts as the evaluations'.
    expert = summary["expert_return_mean"].cast(pl.Float64).mean()
    expert = None if expert is None else float(expert)  # type: ignore[arg-type]
    figures = {
        "figure3": lambda: average_return(shown, episodes.filter(largest), expert, threshold),
        "survival": lambda: survival(shown, threshold),
        "critic": lambda: critic(shown),
        "cost": lambda: cost(shown, seeds.filter(largest), threshold),
        "figure4": lambda: convergence(summary),
        "figure5": lambda: return_after_convergence(summary, expert),
    }
    paths = []
    for name, of_figure in files(folder, summary).items():
        if drawing.save(figures[name], of_figure, say):
            paths += of_figure
    return paths


def files(folder: Path, summary: pl.DataFrame) -> dict[str, list[Path]]:
    """The files of each figure that the cells of `summary` allow."""
    names = ["figure3", "survival", "critic", "cost"]
    if summary.filter(pl.col("n_demos") > 0)["n_demos"].n_unique() > 1:
        names += ["figure4", "figure5"]
    return {name: [folder / f"{name}.png", folder / f"{name}.svg"] for name in names}


def average_return(
    evaluations: pl.DataFrame, episodes: pl.DataFrame, expert: float | None, threshold: float
) -> Figure:
    """Figure 3: noise-free return over environment steps; behaviour return over episodes.

    With many methods a panel for each, over environment steps.
    """
    if evaluations["method"].n_unique() > MOST_CURVES:
        return _panels(evaluations, expert, threshold)
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for method, line in curves.lines(evaluations).items():
        rows = evaluations.filter((pl.col("method") == method) & (pl.col("protocol") == "steps"))
        curves.band(left, rows, "env_step", "return_mean", method, line)
        rows = episodes.filter(pl.col("method") == method)
        if rows.height:
            # The curve ends where the first seed runs out of episodes: a mean over the seeds that
            # are left would be over other seeds.
            last = rows.group_by("seed").agg(pl.col("episode").max())
            seeds = evaluations.filter(pl.col("method") == method)["seed"].n_unique()
            shortest = last["episode"].min() if last.height == seeds else 0
            curves.band(
                right,
                rows.filter(pl.col("episode") <= shortest),
                "episode",
                "return",
                method,
                line,
            )
    for axes in (left, right):
        curves.levels(axes, expert, threshold)
    left.set(
        title="Evaluation without exploration noise",
        xlabel="environment steps",
        ylabel="average return",
    )
    right.set(title="Training episodes, with exploration noise", xlabel="episodes")
    curves.legend(figure, left)
    seeds = evaluations["seed"].n_unique()
    n_demos = evaluations["n_demos"].max()
    figure.suptitle(
        f"Mean over {seeds} seeds and its 95% interval; {n_demos} demonstrations", fontsize=10
    )
    return figure


def _panels(evaluations: pl.DataFrame, expert: float | None, threshold: float) -> Figure:
    """Noise-free return over environment steps, a panel for each method beside the first one."""
    lines = curves.lines(evaluations)
    columns = 4
    rows = -(-len(lines) // columns)
    figure = Figure(figsize=(11, 2.4 * rows), layout="constrained")
    panels = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    by_steps = evaluations.filter(pl.col("protocol") == "steps")
    first = next(iter(lines))
    for method, axes in zip(lines, panels, strict=False):
        if method != first:
            grey = {"color": "0.6", "linestyle": "-"}
            reference = by_steps.filter(pl.col("method") == first)
            curves.band(axes, reference, "env_step", "return_mean", first, grey)
        one = by_steps.filter(pl.col("method") == method)
        curves.band(
            axes, one, "env_step", "return_mean", method, lines[method] | {"linestyle": "-"}
        )
        curves.levels(axes, expert, threshold)
        axes.set_title(METHODS[method].label or method, fontsize=10)
    for axes in panels[len(lines) :]:
        axes.set_axis_off()
    figure.supxlabel("environment steps", fontsize=10)
    figure.supylabel("average return without noise", fontsize=10)
    seeds = evaluations["seed"].n_unique()
    label = METHODS[first].label or first
    figure.suptitle(
        f"Mean over {seeds} seeds and its 95% interval; grey: {label}; dashed: experts; dotted: "
        "solved",
        fontsize=10,
    )
    return figure


def survival(evaluations: pl.DataFrame, threshold: float) -> Figure:
    """The share of seeds that have not solved the task yet, over environment steps."""
    figure = Figure(figsize=(6.5, 4), layout="constrained")
    axes = figure.subplots()
    by_steps = evaluations.filter(pl.col("protocol") == "steps")
    for method, line in curves.lines(evaluations).items():
        rows = by_steps.filter(pl.col("method") == method)
        if rows["env_step"].max() == 0:
            continue
        times = rows.group_by("seed", maintain_order=True).agg(
            pl.col("env_step").filter(pl.col("return_mean") >= threshold).min()
        )
        left = intervals.survival(times["env_step"].fill_null(np.inf).cast(pl.Float64).to_numpy())
        at = np.r_[0.0, left.time, float(rows["env_step"].max())]  # type: ignore[arg-type]
        share, low, high = (np.r_[1.0, x, x[-1]] for x in (left.share, left.low, left.high))
        axes.step(at, share, where="post", **line, label=METHODS[method].label or method)
        axes.fill_between(at, low, high, step="post", color=line["color"], alpha=0.15, linewidth=0)
    axes.set(xlabel="environment steps", ylabel="share of seeds not solved yet", ylim=(-0.02, 1.02))
    curves.legend(figure, axes)
    figure.suptitle("Kaplan-Meier curves, with pointwise 95% intervals", fontsize=10)
    return figure


def critic(evaluations: pl.DataFrame) -> Figure:
    """How stable the critic is: its values and its loss over environment steps (section 4.2)."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    by_steps = evaluations.filter(pl.col("protocol") == "steps")
    for method, line in curves.lines(evaluations).items():
        rows = by_steps.filter(pl.col("method") == method)
        for axes, column in ((left, "q_mean"), (right, "critic_loss")):
            known = rows.filter(pl.col(column).is_not_null())
            if known.height:
                curves.band(axes, known, "env_step", column, method, line)
    left.set(xlabel="environment steps", ylabel="Q over the minibatches")
    right.set(xlabel="environment steps", ylabel="squared temporal-difference error", yscale="log")
    curves.legend(figure, left)
    figure.suptitle("Means over the seeds and their 95% intervals", fontsize=10)
    return figure


def cost(evaluations: pl.DataFrame, seeds: pl.DataFrame, threshold: float) -> Figure:
    """Noise-free return over all environment steps: those of experts and demonstrations too."""
    figure = Figure(figsize=(6.5, 4), layout="constrained")
    axes = figure.subplots()
    by_steps = evaluations.filter(pl.col("protocol") == "steps")
    for method, line in curves.lines(evaluations).items():
        rows = by_steps.filter(pl.col("method") == method)
        before = statistics.steps_before(seeds.filter(pl.col("method") == method)).mean()
        total = rows.with_columns(env_step=pl.col("env_step") + before)
        if rows["env_step"].max() == 0:
            mean, at = intervals.mean(rows["return_mean"].to_numpy()).estimate, before
            axes.plot([at], [mean], "o", color=line["color"], label=METHODS[method].label or method)
            continue
        curves.band(axes, total, "env_step", "return_mean", method, line)
    curves.levels(axes, None, threshold)
    axes.set(
        xlabel="environment steps of learner, demonstrations and expert",
        ylabel="average return",
        xlim=(0, None),
    )
    curves.legend(figure, axes)
    figure.suptitle("What it costs in all; means over the seeds and 95% intervals", fontsize=10)
    return figure


def convergence(summary: pl.DataFrame) -> Figure:
    """Figure 4: episodes and environment steps until convergence, over N_T."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    _over_demonstrations(left, summary, "convergence_episode_median")
    left.set(ylabel="median episodes")
    _over_demonstrations(right, summary, "convergence_env_step_median")
    right.set(ylabel="median environment steps")
    curves.legend(figure, left)
    figure.suptitle(
        "Until convergence: first evaluation at the reward threshold; 95% intervals", fontsize=10
    )
    return figure


def return_after_convergence(summary: pl.DataFrame, expert: float | None) -> Figure:
    """Figure 5: mean return from convergence to the end of the run, over N_T."""
    figure = Figure(figsize=(5.5, 4), layout="constrained")
    axes = figure.subplots()
    _over_demonstrations(axes, summary, "return_after_convergence")
    curves.levels(axes, expert, None)
    axes.set(ylabel="average return after convergence")
    curves.legend(figure, axes)
    figure.suptitle("Mean over the seeds that converged and its 95% interval", fontsize=10)
    return figure


def _over_demonstrations(axes: Axes, summary: pl.DataFrame, column: str) -> None:
    numbers = sorted(set(summary.filter(pl.col("n_demos") > 0)["n_demos"]))
    positions = np.arange(len(numbers))
    lines = curves.lines(summary)
    for index, (method, line) in enumerate(lines.items()):
        rows = summary.filter(pl.col("method") == method).sort("n_demos")
        low, middle, high = (
            rows[column + end].cast(pl.Float64).to_numpy() for end in ("_low", "", "_high")
        )
        label = METHODS[method].label or method
        if np.isnan(middle).all():
            continue
        if rows["n_demos"].max() == 0:
            axes.axhline(middle[0], **line, label=label)
            if not np.isnan(high[0]):
                axes.axhspan(low[0], high[0], color=line["color"], alpha=0.15, linewidth=0)
            continue
        at = positions[np.isin(numbers, rows["n_demos"].to_numpy())]
        offset = 0.06 * (index - (len(lines) - 1) / 2)
        # A median that was never reached is left out; an arrow means an unbounded interval.
        unbounded = np.isnan(high) & ~np.isnan(middle)
        bars = np.array([middle - low, np.where(np.isnan(high), 0.0, high - middle)])
        axes.plot(
            (at + offset)[unbounded], middle[unbounded], "^", color=line["color"], markersize=10
        )
        axes.errorbar(
            at + offset,
            middle,
            bars,
            **line,
            marker="o",
            capsize=3,
            label=label,
        )
    axes.set_xticks(positions, [str(number) for number in numbers])
    axes.set_xlabel("demonstrations $N_T$")
