"""Live progress on a terminal, plain lines elsewhere."""

import contextlib
import time
from collections.abc import Iterator
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

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


@contextlib.contextmanager
def reporter(console: Console, parts: int, total_steps: int) -> Iterator[Reporter]:
    """A reporter for a run of `parts` parts and at most `total_steps` learning steps in all."""
    if not console.is_terminal:
        yield _Plain(console, parts, total_steps)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[rate]} steps/s"),
        TextColumn("solved {task.fields[solved]:.0%}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        yield _Live(progress, parts, total_steps)


class _Live:
    """A progress bar."""

    def __init__(self, progress: Progress, parts: int, total_steps: int):
        self.progress, self.parts, self.part = progress, parts, 0
        self.task = progress.add_task("starting", total=total_steps, rate="-", solved=0.0)

    def start(self, name: str) -> None:
        self.part += 1
        description = f"[{self.part}/{self.parts}] {name} (compiling)"
        self.progress.update(self.task, description=description)

    def go_on(self, learning_steps: int) -> None:
        total = self.progress.tasks[0].total
        assert total is not None
        self.progress.update(self.task, total=total - learning_steps)

    def advance(self, learning_steps: int, solved_fraction: float) -> None:
        speed = self.progress.tasks[0].speed
        self.progress.update(
            self.task,
            advance=learning_steps,
            description=self.progress.tasks[0].description.removesuffix(" (compiling)"),
            solved=solved_fraction,
            rate="-" if speed is None else f"{speed:,.0f}",
        )


class _Plain:
    """A line every `PLAIN_INTERVAL` seconds, for logs."""

    def __init__(self, console: Console, parts: int, total_steps: int):
        self.console, self.parts, self.total = console, parts, total_steps
        self.part, self.name, self.done = 0, "", 0
        self.began = self.printed = time.monotonic()
        self.done_when_printed = 0

    def start(self, name: str) -> None:
        self.part, self.name = self.part + 1, name
        self._print(f"[{self.part}/{self.parts}] {name}")

    def go_on(self, learning_steps: int) -> None:
        self.total -= learning_steps

    def advance(self, learning_steps: int, solved_fraction: float) -> None:
        self.done += learning_steps
        now = time.monotonic()
        if now - self.printed < PLAIN_INTERVAL:
            return
        rate = (self.done - self.done_when_printed) / (now - self.printed)
        left = (self.total - self.done) * (now - self.began) / max(self.done, 1)
        self.printed, self.done_when_printed = now, self.done
        self._print(
            f"[{self.part}/{self.parts}] {self.name}: {self.done / self.total:.0%} of the run, "
            f"solved {solved_fraction:.0%}, {rate:,.0f} steps/s, {left:.0f} s left"
        )

    def _print(self, line: str) -> None:
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)
