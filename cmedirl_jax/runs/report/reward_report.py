"""The report on a run's rewards: tables, pictures and a page in RUN/reward."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import polars as pl

from cmedirl_jax.runs import drawing
from cmedirl_jax.runs.drawing import Figure
from cmedirl_jax.runs.report import (
    markup,
    retrained,
    reward_agreement,
    reward_cards,
    reward_diagnostics,
    reward_maps,
    reward_slices,
)
from cmedirl_jax.runs.report.base import Run
from cmedirl_jax.runs.report.reward_samples import LEARNER, RewardedRun
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import outputs

CAPTIONS = {
    "maps": "Learned rewards, mean over the seeds, beside the task's own and the optimum's value; "
    "and what demonstrations and policies visit.",
    "slices": "Learned rewards along one input, the others as they were demonstrated: the mean "
    "over the seeds, and the middle 90% of them.",
    "agreement": "How far the rewards of a method's seeds are from each other.",
    "retraining": "Fresh agents that learn from each reward alone, judged by the task's own; all "
    "others are scaled to one root mean square.",
}
"""What is written below each picture, in the page's order."""
AGENTS_FILE = "retraining.parquet"
"""The evaluations of fresh agents."""


class RewardReport(NamedTuple):
    """What is known of a run's rewards.

    Attributes:
        rows: a row for each reward.
        summary: a row for each measure of each method.
        correlations: a row for each diagnostic of each method.
        retraining: a row for each measure of each method's agents; None without.
        outdated: a line on the rewards that have no fresh agents yet; None: all have.
    """

    rows: pl.DataFrame
    summary: pl.DataFrame
    correlations: pl.DataFrame
    retraining: pl.DataFrame | None = None
    outdated: str | None = None


def write(
    run: Run,
    rewarded: RewardedRun,
    plan: retrained.Retraining | None,
    say: Callable[[str], None],
    complain: Callable[[str], None],
) -> RewardReport:
    """Assess a run's rewards, and write what was found.

    Args:
        run: the run.
        rewarded: its rewards.
        plan: what to retrain; None: nothing. What was retrained before stays.
        say: called with a line about what takes long.
        complain: called with a line about a picture that cannot be drawn.

    Raises:
        OSError: if a file cannot be written.
    """
    folder = run.folder / run_folder.REWARD
    report, figures = _assess(run, rewarded, folder)
    if plan is not None:
        _retrain(rewarded, plan, folder / AGENTS_FILE, say)
    if (folder / AGENTS_FILE).is_file():
        report, figures["retraining"] = _add_agents(report, run, rewarded, folder)
    pictures = {
        name: folder / f"{name}.png"
        for name, figure in figures.items()
        if drawing.save(figure, [folder / f"{name}.png", folder / f"{name}.svg"], complain)
    }
    outputs.write(folder / "report.html", _page(run, report, pictures).encode())
    return report


def _assess(
    run: Run, rewarded: RewardedRun, folder: Path
) -> tuple[RewardReport, dict[str, Callable[[], Figure]]]:
    """Put each reward beside the task's, demonstrations and other seeds'; write the tables.

    Returns:
        What was found, and the figures by name, not drawn yet.
    """
    seeds = run.tables["seeds"]
    agreement = reward_agreement.of_run(rewarded)
    rows = reward_cards.of_run(rewarded).join(reward_agreement.rows(agreement), on=LEARNER)
    importances = reward_slices.importances(rewarded)
    learners = reward_diagnostics.of_learners(rows, run.tables["evaluations"])
    outputs.write_table(folder / "seeds.parquet", rows)
    outputs.write_table(folder / "diagnostics.parquet", learners)
    report = RewardReport(
        rows,
        _csv(folder / "summary.csv", reward_cards.summarise(rows, seeds)),
        _csv(folder / "diagnostics.csv", reward_diagnostics.correlations(learners)),
    )
    names = {name: name for name in reward_slices.inputs(rewarded.context.env)}
    _csv(folder / "importance.csv", reward_cards.summarise(importances, seeds, names))
    figures: dict[str, Callable[[], Figure]] = {
        "slices": reward_slices.figure(rewarded, importances),
        "agreement": functools.partial(reward_agreement.figure, agreement),
    }
    if (maps := reward_maps.of_run(rewarded)) is not None:
        figures["maps"] = maps
    return report, figures


def _retrain(
    rewarded: RewardedRun, plan: retrained.Retraining, path: Path, say: Callable[[str], None]
) -> None:
    """Train fresh agents, and write their evaluations to `path`."""
    # Written after each reward: a command that is stopped keeps those that are done.
    trained: list[pl.DataFrame] = []
    for table in retrained.of_run(rewarded, plan, say):
        trained.append(table)
        outputs.write_table(path, pl.concat(trained))


def _add_agents(
    report: RewardReport, run: Run, rewarded: RewardedRun, folder: Path
) -> tuple[RewardReport, Callable[[], Figure]]:
    """The report with what the fresh agents in `folder` achieve, and its figure."""
    evaluations, seeds = pl.read_parquet(folder / AGENTS_FILE), run.tables["seeds"]
    measured = retrained.measured(evaluations)
    summary = reward_cards.summarise(measured, seeds, retrained.MEASURES)
    report = report._replace(
        retraining=_csv(folder / "retraining.csv", summary),
        outdated=_outdated(report.rows, evaluations),
    )
    threshold = rewarded.context.env.spec.reward_threshold
    return report, functools.partial(retrained.figure, evaluations, seeds, threshold)


def _outdated(rows: pl.DataFrame, evaluations: pl.DataFrame) -> str | None:
    """A line on the rewards that have no fresh agents yet; None: all have."""
    missing = rows.join(evaluations, on=LEARNER, how="anti")
    if missing.is_empty():
        return None
    methods = ", ".join(missing["method"].unique(maintain_order=True))
    return f"Rewards that came later have no fresh agents: {methods}; give --retrain again."


def _csv(path: Path, table: pl.DataFrame) -> pl.DataFrame:
    outputs.write(path, table.write_csv().encode())
    return table


def _page(run: Run, report: RewardReport, pictures: dict[str, Path]) -> str:
    title = f"The learned rewards of {run.config['env']}"
    parts = [
        f"<h1>{markup.text(title)}</h1>",
        "<p>Means over the learners; brackets are 95% intervals. "
        '<a href="../report.html">The run</a>.</p>',
        "<h2>What the rewards know</h2>",
        _table(report.summary, "measure", ("mean", "low", "high")),
        markup.definitions(reward_cards.MEASURES),
    ]
    if not report.correlations.is_empty():
        parts += [
            "<h2>What tells how a learner performs</h2>",
            "<p>Spearman's rank correlation of each diagnostic with the learners' return in the "
            "last quarter of their evaluations.</p>",
            _table(report.correlations, "diagnostic", ("rank_correlation", "low", "high")),
            markup.definitions(reward_diagnostics.DIAGNOSTICS),
        ]
    if report.retraining is not None:
        parts.append("<h2>Fresh agents on each reward alone</h2>")
        parts.append(f"<p>{markup.text(report.outdated)}</p>" if report.outdated else "")
        for (physics,), rows in report.retraining.group_by("physics", maintain_order=True):
            parts.append(f"<h3>{markup.text(physics)} physics</h3>")
            parts.append(_table(rows, "measure", ("mean", "low", "high")))
        parts.append(markup.definitions(retrained.MEASURES))
    shown = [name for name in CAPTIONS if name in pictures]
    parts += [markup.figure(pictures[name], CAPTIONS[name]) for name in shown]
    return markup.document(title, parts)


def _table(rows: pl.DataFrame, by: str, columns: tuple[str, str, str]) -> str:
    """A row for each method, a column for each value of `by`, as a number with its interval."""
    heads = rows[by].unique(maintain_order=True).to_list()
    body = []
    for (method, n_demos), of_method in rows.group_by("method", "n_demos", maintain_order=True):
        of_head = {row[by]: [row[column] for column in columns] for row in of_method.to_dicts()}
        name = markup.name(str(method), f"{n_demos} demonstrations" if n_demos else None)
        body.append([name, *(markup.interval(of_head.get(head, [None])) for head in heads)])
    return markup.table(["method", *(head.replace("_", " ") for head in heads)], body)
