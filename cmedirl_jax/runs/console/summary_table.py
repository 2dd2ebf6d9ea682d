"""The summary of a run as a printed table."""

from typing import Any

import polars as pl
from rich import box
from rich.table import Table


def of(summary: pl.DataFrame) -> Table:
    """The summary as a paper would print it."""
    title = f"{summary['seeds'].max()} seeds per row; 95% intervals"
    if summary["experts"].max() == 1:
        title += ", of this one expert"
    printed = Table(title=title, box=box.SIMPLE)
    printed.add_column("method")
    printed.add_column("N_T", justify="right")
    for name in (
        "converged",
        "steps until\nconverged",
        "dip fraction",
        "area",
        "final return",
        "best policy",
    ):
        printed.add_column(name, justify="right")
    for row in summary.iter_rows(named=True):
        printed.add_row(
            row["method"],
            str(row["n_demos"]) if row["n_demos"] else "-",
            _interval(row, "converged_fraction", "{:.2f}"),
            _interval(row, "convergence_env_step_median", "{:,.0f}"),
            _interval(row, "dip_fraction", "{:.3f}"),
            _interval(row, "area", "{:.1f}"),
            _spread(row, "final_return"),
            _spread(row, "best_return"),
        )
    return printed


def _interval(row: dict[str, Any], name: str, form: str) -> str:
    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    if value is None:
        return "-"
    bounds = ("?" if bound is None else form.format(bound) for bound in (low, high))
    return f"{form.format(value)}\n\\[{', '.join(bounds)}]"


def _spread(row: dict[str, Any], name: str) -> str:
    mean, std = row[f"{name}_mean"], row[f"{name}_std"]
    return f"{mean:.2f}" if std is None else f"{mean:.2f}\n± {std:.2f}"
