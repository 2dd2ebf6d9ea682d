"""What reports are made of, and what becomes of them."""

from pathlib import Path
from typing import Any, NamedTuple

import polars as pl


class Run(NamedTuple):
    """A run on disk: its folder, its configuration, its task's threshold, its tables by name."""

    folder: Path
    config: dict[str, Any]
    threshold: float
    tables: dict[str, pl.DataFrame]


class Verdicts(NamedTuple):
    """What a caller concludes from a run: `claims.md`, and its section of the page.

    Attributes:
        markdown: the file's text.
        html: the section, which stands before the results.
    """

    markdown: str
    html: str


class Report(NamedTuple):
    """What became of a report.

    Attributes:
        summary: a row for each cell.
        wrong: a line for each figure that could not be drawn.
    """

    summary: pl.DataFrame
    wrong: list[str]
