"""Live progress on a terminal, plain lines elsewhere."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column

from cmedirl_jax.runs.cells import cell
from cmedirl_jax.runs.cells.record import EvaluationRows
from cmedirl_jax.runs.console import compile_cache, screen

PLAIN_INTERVAL = 10.0
"""Seconds between plain lines."""


class Reporter(Protocol):
    """Where a run says how far it is."""

    def start(self, name: str) -> None:
        """A part of the run begins."""
        ...

    def go_on(self, learning_steps: int) -> None:
        """The part continues from a checkpoint that lies so many learning steps ahead."""
        ...

    def advance(self, learning_steps: int, solved_fraction: float) -> None:
        """The part took so many more learning steps; this share of its seeds solves the task."""
        ...


def stepwise(
    report: Reporter,
    seeds_count: int,
    follow: Callable[[Sequence[EvaluationRows]], None] = lambda evaluations: None,
) -> Callable[[cell.Progress], None]:
    """Report a cell's progress, which counts from its first step, as increments.

    Args:
        report: where.
        seeds_count: how many seeds the cell has.
        follow: called each time with all evaluations so far.
    """
    before: int | None = None

    def advance(progress: cell.Progress) -> None:
        nonlocal before
        if before is None:
            report.go_on(progress.env_step * seeds_count)
        else:
            report.advance((progress.env_step - before) * seeds_count, progress.solved_fraction)
        before = progress.env_step
        follow(progress.evaluations)

    return advance


@contextlib.contextmanager
def reporter(console: Console, parts: int, total_steps: int) -> Iterator[Reporter]:
    """A reporter for a run of `parts` parts and at most `total_steps` learning steps in all."""
    with compile_cache.counted() as cost:
        pace = _Pace(parts, total_steps, cost)
        if not console.is_interactive:
            yield _Plain(console, pace)
            return
        columns = [TextColumn("{task.description}", table_column=Column(overflow="fold"))]
        if console.width >= 80:
            columns = [BarColumn(20), TimeElapsedColumn(), *columns]
        with Progress(*columns, console=console, transient=True) as progress:
            yield _Live(progress, pace)


class _Pace:
    """How far a run is, how fast it goes, and how long it will take.

    Only time in which nothing was compiled counts for the rate.
    """

    def __init__(self, parts: int, total_steps: int, cost: compile_cache.Cost):
        self.parts, self.total, self.cost = parts, total_steps, cost
        self.part, self.name, self.done = 0, "", 0
        self.began = self.reported = time.monotonic()
        self.compiled = cost.seconds
        # Learning steps, and the seconds that they took.
        self.measured = self.measured_before = np.zeros(2)

    @property
    def title(self) -> str:
        """The part, and its place among the parts."""
        return f"[{self.part}/{self.parts}] {self.name}"

    def start(self, name: str) -> None:
        """The next part begins."""
        self.part, self.name = self.part + 1, name
        self._look()

    def go_on(self, learning_steps: int) -> None:
        """The part need not take these steps."""
        self.total -= learning_steps
        self._look()

    def advance(self, learning_steps: int) -> None:
        """The part took these steps."""
        before, compiled = self.reported, self.compiled
        self._look()
        self.done += learning_steps
        if self.compiled == compiled:
            self.measured = self.measured + np.array([learning_steps, self.reported - before])

    def _look(self) -> None:
        self.reported, self.compiled = time.monotonic(), self.cost.seconds

    def line(self, solved_fraction: float) -> str:
        """All that is known so far; the rate is that since the line before."""
        shown = [f"{self.title}: {self.done / self.total:.0%} of the run"]
        shown.append(f"solved {solved_fraction:.0%}")
        steps, seconds = self.measured - self.measured_before
        self.measured_before = self.measured
        if seconds:
            shown.append(f"{steps / seconds:,.0f} steps/s")
        steps, seconds = self.measured
        if seconds:
            per_step = seconds / steps
            # Each part to come also takes what those so far took beside their steps: compiling.
            beside = max(0.0, self.reported - self.began - self.done * per_step) / self.part
            left = (self.total - self.done) * per_step + (self.parts - self.part) * beside
            shown.append(f"{left:.0f} s left")
        return ", ".join(shown)


class _Live:
    """A progress bar."""

    def __init__(self, progress: Progress, pace: _Pace):
        self.progress, self.pace = progress, pace
        self.task = progress.add_task("starting", total=pace.total)

    def start(self, name: str) -> None:
        self.pace.start(name)
        self.progress.update(self.task, description=f"{self.pace.title} (compiling)")

    def go_on(self, learning_steps: int) -> None:
        self.pace.go_on(learning_steps)
        self.progress.update(self.task, total=self.pace.total)

    def advance(self, learning_steps: int, solved_fraction: float) -> None:
        self.pace.advance(learning_steps)
        description = self.pace.line(solved_fraction)
        self.progress.update(self.task, advance=learning_steps, description=description)


class _Plain:
    """A line every `PLAIN_INTERVAL` seconds, for logs."""

    def __init__(self, console: Console, pace: _Pace):
        self.console, self.pace = console, pace
        self.printed = pace.began

    def start(self, name: str) -> None:
        self.pace.start(name)
        screen.say(self.console, self.pace.title)

    def go_on(self, learning_steps: int) -> None:
        self.pace.go_on(learning_steps)

    def advance(self, learning_steps: int, solved_fraction: float) -> None:
        self.pace.advance(learning_steps)
        if self.pace.reported - self.printed >= PLAIN_INTERVAL:
            self.printed = self.pace.reported
            screen.say(self.console, self.pace.line(solved_fraction))
