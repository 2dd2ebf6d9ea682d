"""Write what is said of a run's rewards: tables, pictures and a page in RUN/reward."""

import functools
import io
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
from cmedirl_jax.runs.report.reward_samples import Judged
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import outputs

CAPTIONS = {
    "maps": "Learned rewards, mean over the seeds, beside the task's own and the optimum's value; "
    "and what demonstrations and policies visit.",
    "slices": "Learned rewards along one input, the others as they were demonstrated: the mean "
    "over the seeds, and the middle 90% of them.",
    "agreement": "How far the rewards of a method's seeds are from each other.",
    "retraining": "Fresh agents that learn from each reward alone, judged by the task's own.",
}
"""What is written below each picture, in the page's order."""


class Judgement(NamedTuple):
    """What is said of a run's rewards.

    Attributes:
        rows: a row for each reward.
        summary: a row for each measure of each cell.
        trusted: a row for each diagnostic of each cell.
        retraining: a row for each measure of each cell's agents; None without.
    """

    rows: pl.DataFrame
    summary: pl.DataFrame
    trusted: pl.DataFrame
    retraining: pl.DataFrame | None


def write(
    run: Run, judged: Judged, plan: retrained.Plan | None, say: Callable[[str], None]
) -> Judgement:
    """Judge a run's rewards, and write what was found.

    Args:
        run: the run.
        judged: its rewards.
        plan: what to retrain; None: nothing. What was retrained before stays.
        say: called with a line about what takes long, or cannot be drawn.

    Raises:
        OSError: if a file cannot be written.
    """
    to, seeds = run.folder / run_folder.REWARD, run.tables["seeds"]
    shared = ["method", "n_demos", "seed"]

    # Each reward beside the task's, beside demonstrations, and beside those of other seeds.
    agreement = reward_agreement.of_run(judged)
    rows = reward_cards.of_run(judged).join(reward_agreement.rows(agreement), on=shared)
    importances = reward_slices.importances(judged)
    learners = reward_diagnostics.of_learners(rows, run.tables["evaluations"])
    _parquet(to / "seeds.parquet", rows)
    _parquet(to / "diagnostics.parquet", learners)
    found = Judgement(
        rows,
        _csv(to / "summary.csv", reward_cards.summarise(rows, seeds)),
        _csv(to / "diagnostics.csv", reward_diagnostics.trusted(learners)),
        None,
    )
    names = {name: name for name in reward_slices.inputs(judged.context.env)}
    _csv(to / "importance.csv", reward_cards.summarise(importances, seeds, names))
    figures: dict[str, Callable[[], Figure]] = {
        "slices": reward_slices.figure(judged, importances),
        "agreement": functools.partial(reward_agreement.figure, agreement),
    }
    if (maps := reward_maps.of_run(judged)) is not None:
        figures["maps"] = maps

    # Fresh agents.
    agents = to / "retraining.parquet"
    if plan is not None:
        _parquet(agents, retrained.of_cells(judged.context, plan, judged.cells, say))
    if agents.is_file():
        evaluations = pl.read_parquet(agents)
        measured = retrained.measured(evaluations)
        summary = reward_cards.summarise(measured, seeds, retrained.MEASURES)
        found = found._replace(retraining=_csv(to / "retraining.csv", summary))
        threshold = judged.context.env.spec.reward_threshold
        figures["retraining"] = functools.partial(retrained.figure, evaluations, threshold)

    # Pictures and markup.
    for name, figure in figures.items():
        drawing.save(figure, [to / f"{name}.png", to / f"{name}.svg"], say)
    pictures = {name: to / f"{name}.png" for name in CAPTIONS if name in figures}
    outputs.write(to / "report.html", _page(run, found, pictures).encode())
    return found


def _parquet(path: Path, table: pl.DataFrame) -> None:
    buffer = io.BytesIO()
    table.write_parquet(buffer)
    outputs.write(path, buffer.getvalue())


def _csv(path: Path, table: pl.DataFrame) -> pl.DataFrame:
    outputs.write(path, table.write_csv().encode())
    return table


def _page(run: Run, found: Judgement, pictures: dict[str, Path]) -> str:
    title = f"The learned rewards of {run.config['env']}"
    parts = [
        f"<h1>{markup.text(title)}</h1>",
        "<p>Means over the learners; brackets are 95% intervals.</p>",
        "<h2>What the rewards know</h2>",
        _by_cell(found.summary, "measure", ("mean", "low", "high")),
        markup.definitions(reward_cards.MEASURES),
        "<h2>What tells how a learner performs</h2>",
        "<p>Spearman's rank correlation of each diagnostic with the learners' return in the last "
        "quarter of their evaluations.</p>",
        _by_cell(found.trusted, "diagnostic", ("rank_correlation", "low", "high")),
        markup.definitions(reward_diagnostics.DIAGNOSTICS),
    ]
    if found.retraining is not None:
        parts.append("<h2>Fresh agents on each reward alone</h2>")
        for (physics,), rows in found.retraining.group_by("physics", maintain_order=True):
            parts.append(f"<h3>{markup.text(physics)} physics</h3>")
            parts.append(_by_cell(rows, "measure", ("mean", "low", "high")))
        parts.append(markup.definitions(retrained.MEASURES))
    parts += [markup.figure(path, CAPTIONS[name]) for name, path in pictures.items()]
    return markup.document(title, parts)


def _by_cell(rows: pl.DataFrame, by: str, columns: tuple[str, str, str]) -> str:
    """A row for each cell, a column for each value of `by`, as a number with its interval."""
    heads = rows[by].unique(maintain_order=True).to_list()
    body = []
    for (method, n_demos), cell in rows.group_by("method", "n_demos", maintain_order=True):
        of_head = {row[by]: row for row in cell.iter_rows(named=True)}
        values = (
            [of_head[head][column] for column in columns] if head in of_head else [None]
            for head in heads
        )
        name = markup.name(str(method), f"{n_demos} demonstrations" if n_demos else None)
        body.append([name, *(markup.interval(each) for each in values)])
    return markup.table(["method", *(head.replace("_", " ") for head in heads)], body)
