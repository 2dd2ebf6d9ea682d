"""Standard output as rich prints on it: a terminal of any width, a file, or nothing."""

from rich.console import Console
from rich.table import Table

from cmedirl_jax.runs.console import streams

WIDE = 1_000
"""Columns of a file or a pipe: more than any table has."""


def console() -> Console:
    """Standard output; what cannot be printed is left out."""
    stream = streams.dispensable()
    if stream is None or not stream.isatty():
        return Console(file=stream, width=WIDE, force_interactive=False)
    console = Console(file=stream)
    # Some terminals inherit COLUMNS=0, on which rich prints nothing.
    console.width = console.width or 80
    return console


def show(console: Console, table: Table) -> None:
    """Print a table; where it is too wide, each of its cells as a line."""
    natural = console.measure(table, options=console.options.update(max_width=WIDE)).maximum
    if natural <= console.width:
        console.print(table)
        return
    console.print(table.title)
    for row in zip(*(column.cells for column in table.columns), strict=True):
        console.print()
        for column, cell in zip(table.columns, row, strict=True):
            console.print(f"{column.header}: {cell}".replace("\n", " "), highlight=False)


def say(console: Console, line: str) -> None:
    """Print a line as it is: neither broken nor marked up."""
    console.print(line, markup=False, highlight=False, soft_wrap=True)
