"""The report of a run as one HTML page that needs no other file: `report.html` in its folder."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl

from cmedirl_jax.runs.report import markup
from cmedirl_jax.runs.report.summary import cell_label
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.training.methods import METHODS

CAPTIONS = {
    "figure3": "Figure 3: average return during training.",
    "survival": "How many seeds have not solved the task yet.",
    "profile": "How many seeds return more than each score.",
    "critic": "The stability of the Q network, the paper's second criterion.",
    "cost": "Return over all environment steps, those of experts and demonstrations included.",
    "figure4": "Figure 4: episodes and environment steps until convergence, over the number of "
    "demonstrations.",
    "figure5": "Figure 5: average return after convergence, over the number of demonstrations.",
}
"""What is written below each figure, in the page's order."""

_COLUMNS = (
    ("converged_fraction", "solved", "{:.2f}"),
    ("convergence_env_step_median", "steps to solve, median", "{:,.0f}"),
    ("sustained_fraction", "stayed solved", "{:.2f}"),
    ("failed_fraction", "failed at the end", "{:.2f}"),
    ("area", "mean of all evaluations", "{:.1f}"),
    ("iqm", "last return, IQM", "{:.2f}"),
)
"""Columns of summary.csv with intervals, as the page shows them."""

_EPISODES = ("convergence_episode_median", "episodes to solve, median", "{:,.0f}")
"""In place of steps, where every seed lives as many episodes."""


def page(
    config: Mapping[str, Any],
    summary: pl.DataFrame,
    threshold: float,
    figures: Mapping[str, Path],
    versions: Mapping[str, str],
    *,
    by_episodes: bool = False,
    verdicts: str = "",
) -> str:
    """The page.

    Args:
        config: the run's configuration.
        summary: a row for each cell.
        threshold: return that counts as solved.
        figures: PNG files by their names in `CAPTIONS`; those that are gone are left out.
        versions: of the packages that made the run.
        by_episodes: whether all seeds end at one episode, rather than at one step.
        verdicts: HTML that stands before the results.
    """
    title = f"{config['env']}: {', '.join(config['methods'])}"
    budget = f"{config['max_steps']:,} environment steps" if config["max_steps"] else ""
    if config["max_episodes"]:
        budget = f"{config['max_episodes']} episodes"
    parts = [
        f"<h1>{markup.text(title)}</h1>",
        f"<p>{config['seeds']} seeds of each row, {budget} each; study seed {config['seed']}; "
        f"demonstrations: {markup.text(_demonstrations(config))}. Solved: a mean return of "
        f"{threshold:.4g} at an evaluation. Brackets are 95% intervals.</p>",
        verdicts,
        "<h2>Results</h2>",
        _results(summary, by_episodes),
        *(markup.figure(figures[name], CAPTIONS[name]) for name in CAPTIONS if name in figures),
        _rewards(config),
        _made(config, versions),
    ]
    return markup.document(title, parts)


def _demonstrations(config: Mapping[str, Any]) -> str:
    if not any(METHODS[method].uses_demonstrations for method in config["methods"]):
        return "none"
    return config["demos"] or f"of experts that were trained first ({config['expert']})"


def _results(summary: pl.DataFrame, by_episodes: bool) -> str:
    columns = [
        _EPISODES if by_episodes and name == "convergence_env_step_median" else (name, label, form)
        for name, label, form in _COLUMNS
    ]
    heads = [
        "method",
        *(label for _, label, _ in columns),
        "best policy, its evaluation",
        "the same, fresh starts",
        "its demonstrators",
    ]
    rows = []
    for row in summary.iter_rows(named=True):
        label = METHODS[row["method"]].label if row["method"] in METHODS else None
        rows.append(
            [
                markup.name(cell_label(row["method"], row["n_demos"]), label),
                *(
                    markup.interval([row[column + end] for end in ("", "_low", "_high")], form)
                    for column, _, form in columns
                ),
                *(
                    markup.number(row[column])
                    for column in ("best_evaluation_mean", "best_return_mean", "expert_return_mean")
                ),
            ]
        )
    return markup.table(heads, rows)


def _rewards(config: Mapping[str, Any]) -> str:
    if not any(METHODS[method].reward for method in config["methods"]):
        return ""
    return (
        "<h2>The learned rewards</h2><p>What they are worth says "
        f'<a href="{run_folder.REWARD}/report.html">a page of its own</a>, which '
        "<code>cmedirl reward</code> writes.</p>"
    )


def _made(config: Mapping[str, Any], versions: Mapping[str, str]) -> str:
    made = ", ".join(f"{name} {version}" for name, version in versions.items())
    # Where the results lie is no setting.
    settings = run_folder.flat({**config, "out": None})
    left_out = ("out", "expert") if config["demos"] else ("out",)
    lines = "\n".join(
        f"{name}: {value}" for name, value in settings.items() if not name.startswith(left_out)
    )
    return (
        f"<h2>What was run</h2><p>{markup.text(made)}</p><details><summary>every setting</summary>"
        f"<pre>{markup.text(lines)}</pre></details>"
    )
