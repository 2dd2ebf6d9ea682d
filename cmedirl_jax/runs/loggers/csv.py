"""Tables that any program reads: `csv/SERIES.csv`, a row a step, a column a scalar."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cmedirl_jax.runs.loggers.base import Logger, Point
from cmedirl_jax.runs.storage import outputs


class _Writer:
    """Replaces its file at each write, so that a reader never sees half a row.

    A scalar that is unknown at first adds a column, which is empty in the rows before it.
    """

    def __init__(self, path: Path):
        self._path = path
        self._rows: list[dict[str, float]] = []

    def write(self, points: Sequence[Point]) -> None:
        self._rows += [{"step": point.step, **point.scalars} for point in points]
        columns = dict.fromkeys(name for row in self._rows for name in row)
        text = io.StringIO()
        table = csv.DictWriter(text, list(columns), lineterminator="\n")
        table.writeheader()
        table.writerows(self._rows)
        outputs.write(self._path, text.getvalue().encode())

    def close(self) -> None:
        """Everything is on the disk."""


def _open(folder: Path, series: str, config: Mapping[str, Any]) -> _Writer:
    return _Writer(folder / "csv" / f"{series}.csv")


CSV = Logger(_open)
