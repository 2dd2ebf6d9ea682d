"""The report of a run as one HTML page that needs no other file: `report.html` in its folder."""

import base64
import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl

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

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 0 auto; max-width: 66rem;
  padding: 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.5rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { border-bottom: 1px solid #ddd; padding: 0.3rem 0.5rem; text-align: left;
  vertical-align: top; }
td.number { text-align: right; } td.number, td.name { white-space: nowrap; }
small { color: #555; display: block; }
figure { margin: 2rem 0; overflow-x: auto; } figure img { height: auto; max-width: 100%; }
figure img.broad { min-width: 40rem; }
figcaption { color: #555; font-size: 0.9rem; }
details { margin: 0.3rem 0; } pre { overflow-x: auto; font-size: 0.8rem; }
.supported { color: #006b4d; } .not { color: #a03000; } .other { color: #555; }
"""

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
        f"<h1>{_text(title)}</h1>",
        f"<p>{config['seeds']} seeds of each row, {budget} each; study seed {config['seed']}; "
        f"demonstrations: {_text(_demonstrations(config))}. Solved: a mean return of "
        f"{threshold:.4g} at an evaluation. Brackets are 95% intervals.</p>",
        verdicts,
        "<h2>Results</h2>",
        _results(summary, by_episodes),
        *(_figure(name, figures[name]) for name in CAPTIONS if name in figures),
        _made(config, versions),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(title)}</title><style>{_STYLE}</style></head><body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body></html>\n"
    )


def _demonstrations(config: Mapping[str, Any]) -> str:
    if not any(METHODS[method].uses_demonstrations for method in config["methods"]):
        return "none"
    return config["demos"] or f"of experts that were trained first ({config['expert']})"


def _text(value: object) -> str:
    return html.escape(str(value))


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
    rows = ["<tr>" + "".join(f"<th>{_text(head)}</th>" for head in heads) + "</tr>"]
    for row in summary.iter_rows(named=True):
        label = METHODS[row["method"]].label if row["method"] in METHODS else None
        name = cell_label(row["method"], row["n_demos"])
        cells = [
            f'<td class="name">{_text(name)}'
            + (f"<small>{_text(label)}</small>" if label else "")
            + "</td>"
        ]
        cells += [_interval(row, column, form) for column, _, form in columns]
        cells += [
            f'<td class="number">{_number(row[column], "{:.2f}", "-")}</td>'
            for column in ("best_evaluation_mean", "best_return_mean", "expert_return_mean")
        ]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return f'<div class="wide"><table>{"".join(rows)}</table></div>'


def _interval(row: Mapping[str, Any], column: str, form: str) -> str:
    value, low, high = (row[column + end] for end in ("", "_low", "_high"))
    if value is None:
        return '<td class="number">-</td>'
    bounds = f"[{_number(low, form)}, {_number(high, form)}]"
    return f'<td class="number">{_number(value, form)}<small>{bounds}</small></td>'


def _number(value: float | None, form: str, unknown: str = "?") -> str:
    return unknown if value is None else form.format(value)


def _figure(name: str, path: Path) -> str:
    if not path.is_file():
        return ""
    content = path.read_bytes()
    data = base64.b64encode(content).decode()
    caption = _text(CAPTIONS[name])
    # A PNG's width stands in its header. Text is as large in every figure, and a broad figure
    # scrolls on a narrow screen.
    width = int.from_bytes(content[16:20], "big")
    broad = ' class="broad"' if width > 1_200 else ""
    return (
        f'<figure><img{broad} width="{width * 16 // 25}" src="data:image/png;base64,{data}" '
        f'alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
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
        f"<h2>What was run</h2><p>{_text(made)}</p><details><summary>every setting</summary>"
        f"<pre>{_text(lines)}</pre></details>"
    )
