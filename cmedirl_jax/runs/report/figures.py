"""The figures of a run: the paper's 3, 4 and 5, its critic, its cost, how its seeds spread."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import polars as pl

from cmedirl_jax.runs import drawing, intervals, statistics
from cmedirl_jax.runs.console import streams
from cmedirl_jax.runs.drawing import Axes, Figure
from cmedirl_jax.runs.report import curves, distributions
from cmedirl_jax.runs.report.curves import Over


def draw(
    folder: Path,
    tables: Mapping[str, pl.DataFrame],
    summary: pl.DataFrame,
    threshold: float,
    say: Callable[[str], None] = streams.complain,
    *,
    by_episodes: bool = False,
) -> list[Path]:
    """Draw what the run's cells allow into `folder`, as PNG and SVG.

    Args:
        folder: made if it is missing.
        tables: the run's, by name.
        summary: a row for each cell.
        threshold: return that counts as solved.
        say: called with a line for each figure that cannot be drawn; the others are drawn.
        by_episodes: whether all seeds end at one episode, rather than at one step.

    Returns:
        The files that were written.
    """
    seeds = tables["seeds"]
    largest = pl.col("n_demos").is_in([0, max(seeds["n_demos"])])
    of_seed = ["method", "n_demos", "seed"]
    experts = seeds.select(*of_seed, "expert_id")
    evaluations, episodes = (
        tables[name].join(experts, on=of_seed, how="left", maintain_order="left")
        for name in ("evaluations", "episodes")
    )
    shown = evaluations.filter(largest)
    found = distributions.of_methods(shown, seeds.filter(largest), threshold, by_episodes)
    column = "episode" if by_episodes else "env_step"
    # Where the first seed ends, by whatever, though not by divergence.
    alive = shown.join(seeds.filter(~pl.col("diverged")), on=of_seed, how="semi")
    ends = alive.filter(pl.col("env_step") > 0).group_by("method", "seed").agg(pl.col(column).max())
    last = ends[column].min()
    # The same starts as the evaluations'.
    expert = summary["expert_return_mean"].cast(pl.Float64).mean()
    expert = None if expert is None else float(expert)  # type: ignore[arg-type]
    figures = {
        "figure3": lambda: average_return(
            curves.over(shown, by_episodes), episodes.filter(largest), expert, threshold
        ),
        "survival": lambda: distributions.survival(found, float(last or 0), by_episodes),  # type: ignore[arg-type]
        "profile": lambda: distributions.profile(found),
        "critic": lambda: critic(curves.over(shown, by_episodes)),
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
    names = ["figure3", "survival", "profile", "critic", "cost"]
    if summary.filter(pl.col("n_demos") > 0)["n_demos"].n_unique() > 1:
        names += ["figure4", "figure5"]
    return {name: [folder / f"{name}.png", folder / f"{name}.svg"] for name in names}


def average_return(
    evaluations: Over, episodes: pl.DataFrame, expert: float | None, threshold: float
) -> Figure:
    """Figure 3: noise-free return over environment steps; behaviour return over episodes.

    With many methods a panel for each, of the noise-free return.
    """
    table = evaluations.rows
    if table["method"].n_unique() > curves.MOST_CURVES:
        return _panels(evaluations, expert, threshold)
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for method, line in curves.lines(table["method"]).items():
        rows = table.filter(pl.col("method") == method)
        curves.band(left, rows, evaluations.column, "return_mean", method, line)
        rows = episodes.filter(pl.col("method") == method)
        if rows.height:
            # The curve ends where the first seed runs out of episodes: a mean over the seeds that
            # are left would be over other seeds.
            last = rows.group_by("seed").agg(pl.col("episode").max())
            seeds = table.filter(pl.col("method") == method)["seed"].n_unique()
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
        xlabel=evaluations.label,
        ylabel="average return",
    )
    right.set(title="Training episodes, with exploration noise", xlabel="episodes")
    curves.legend(figure, left)
    seeds, n_demos = table["seed"].n_unique(), table["n_demos"].max()
    figure.suptitle(
        f"Mean over {seeds} seeds and its 95% interval; {n_demos} demonstrations", fontsize=10
    )
    return figure


def _panels(evaluations: Over, expert: float | None, threshold: float) -> Figure:
    """Noise-free return, a panel for each method beside the first one."""
    table, column, unit = evaluations
    lines = curves.lines(table["method"])
    figure, panels = curves.panels(lines)
    first = next(iter(lines))
    for method, axes in panels.items():
        if method != first:
            reference = table.filter(pl.col("method") == first)
            curves.band(axes, reference, column, "return_mean", first, curves.GREY)
        one = table.filter(pl.col("method") == method)
        curves.band(axes, one, column, "return_mean", method, lines[method] | {"linestyle": "-"})
        curves.levels(axes, expert, threshold)
    figure.supxlabel(unit, fontsize=10)
    figure.supylabel("average return without noise", fontsize=10)
    figure.suptitle(
        f"Mean over {table['seed'].n_unique()} seeds and its 95% interval; grey: "
        f"{curves.label(first)}; dashed: experts; dotted: solved",
        fontsize=10,
    )
    return figure


def critic(evaluations: Over) -> Figure:
    """How stable the critic is: its values and its loss (section 4.2)."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for method, line in curves.lines(evaluations.rows["method"]).items():
        rows = evaluations.rows.filter(pl.col("method") == method)
        for axes, column in ((left, "q_mean"), (right, "critic_loss")):
            known = rows.filter(pl.col(column).is_not_null())
            if known.height:
                curves.band(axes, known, evaluations.column, column, method, line)
    left.set(xlabel=evaluations.label, ylabel="Q over the minibatches")
    right.set(xlabel=evaluations.label, ylabel="squared temporal-difference error", yscale="log")
    curves.legend(figure, left)
    figure.suptitle("Means over the seeds and their 95% intervals", fontsize=10)
    return figure


def cost(evaluations: pl.DataFrame, seeds: pl.DataFrame, threshold: float) -> Figure:
    """Noise-free return over all environment steps: those of experts and demonstrations too."""
    figure = Figure(figsize=(6.5, 4), layout="constrained")
    axes = figure.subplots()
    by_steps = evaluations.filter(pl.col("protocol") == "steps")
    for method, line in curves.lines(evaluations["method"]).items():
        rows = by_steps.filter(pl.col("method") == method)
        before = statistics.steps_before(seeds.filter(pl.col("method") == method)).mean()
        total = rows.with_columns(env_step=pl.col("env_step") + before)
        if rows["env_step"].max() == 0:
            mean, at = intervals.mean(rows["return_mean"].to_numpy()).estimate, before
            axes.plot([at], [mean], "o", color=line["color"], label=curves.label(method))
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
    lines = curves.lines(summary["method"])
    for index, (method, line) in enumerate(lines.items()):
        rows = summary.filter(pl.col("method") == method).sort("n_demos")
        low, middle, high = (
            rows[column + end].cast(pl.Float64).to_numpy() for end in ("_low", "", "_high")
        )
        label = curves.label(method)
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
