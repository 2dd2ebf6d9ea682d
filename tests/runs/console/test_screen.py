import io
import os
import sys

import pytest
from rich.console import Console
from rich.table import Table

from cmedirl_jax.runs.console import screen
from cmedirl_jax.training.methods import METHODS

NUMBERS = ("123,456", "[0.000, 1.000]", "-1,234.56")


def table():
    shown = Table(title="95% intervals")
    for name in ("method", "steps until\nconverged", "fraction", "return"):
        shown.add_column(name)
    for method in METHODS:
        shown.add_row(method, *NUMBERS)
    return shown


@pytest.mark.parametrize("width", [1, 40, 80, 120])
def test_every_name_and_every_number_can_be_read(width):
    console = Console(file=io.StringIO(), width=width)
    screen.show(console, table())
    shown = console.file.getvalue()
    assert "…" not in shown
    assert max(map(len, shown.splitlines())) <= width
    if width == 1:
        return
    for method in METHODS:
        assert method in shown.split()
    for number in NUMBERS:
        assert shown.count(number) == len(METHODS)


def test_cells_as_lines_have_their_columns_names():
    console = Console(file=io.StringIO(), width=30)
    screen.show(console, table())
    assert console.file.getvalue().splitlines()[:6] == [
        "95% intervals",
        "",
        "method: ddpg",
        "steps until converged: 123,456",
        "fraction: [0.000, 1.000]",
        "return: -1,234.56",
    ]


def test_a_pipe_is_as_wide_as_it_must_be_whatever_is_inherited(monkeypatch):
    for name, value in {"COLUMNS": "7", "FORCE_COLOR": "1", "TERM": "xterm"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    console = screen.console()
    assert not console.is_interactive
    assert console.width == screen.WIDE
    screen.say(console, "[1/2] a " + "long " * 100)
    assert sys.stdout.getvalue().count("\n") == 1


@pytest.mark.parametrize(("columns", "width"), [("77", 77), ("0", 80), ("many", 80)])
def test_a_terminal_keeps_its_width(monkeypatch, columns, width):
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setenv("TERM", "xterm")
    controller, terminal = os.openpty()
    with os.fdopen(terminal, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        console = screen.console()
        assert console.is_interactive
        assert console.width == width
    os.close(controller)
