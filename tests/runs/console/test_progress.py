import io
import types

import pytest
from rich.console import Console

from cmedirl_jax.runs.console import progress


@pytest.fixture
def clock(monkeypatch):
    clock = types.SimpleNamespace(now=100.0)
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def plain():
    return Console(file=io.StringIO(), width=40)


def terminal(monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    return Console(file=io.StringIO(), force_terminal=True, width=200)


def test_without_a_terminal_each_part_begins_with_a_line(clock):
    console = plain()
    with progress.reporter(console, parts=2, total_steps=4_000) as report:
        report.start("experts")
        report.start("hs-ddpg-n5")
    assert console.file.getvalue() == "[1/2] experts\n[2/2] hs-ddpg-n5\n"


def test_without_a_terminal_a_line_every_few_seconds_says_how_far_the_run_is(clock):
    console = plain()
    with progress.reporter(console, parts=2, total_steps=4_000) as report:
        report.start("ddpg")
        for _ in range(4):
            clock.now += progress.PLAIN_INTERVAL / 2
            report.advance(500, 0.25)
    assert console.file.getvalue().splitlines() == [
        "[1/2] ddpg",
        "[1/2] ddpg: 25% of the run, solved 25%, 100 steps/s, 30 s left",
        "[1/2] ddpg: 50% of the run, solved 25%, 100 steps/s, 20 s left",
    ]


def test_the_rate_is_that_since_the_last_line_and_the_time_left_that_of_the_whole_run(clock):
    console = plain()
    with progress.reporter(console, parts=1, total_steps=4_000) as report:
        report.start("ddpg")
        for learning_steps in (1_000, 2_000):
            clock.now += progress.PLAIN_INTERVAL
            report.advance(learning_steps, 0.0)
    assert "75% of the run, solved 0%, 200 steps/s, 7 s left" in console.file.getvalue()


def test_on_a_terminal_a_bar_names_the_part_and_the_share_solved(monkeypatch):
    console = terminal(monkeypatch)
    with progress.reporter(console, parts=2, total_steps=4_000) as report:
        report.start("experts")
        report.advance(1_000, 0.0)
        report.start("ddpg")
        report.advance(1_000, 0.5)
    written = console.file.getvalue()
    assert "[2/2] ddpg" in written
    assert "solved 50%" in written
    assert "compiling" not in written.rpartition("[2/2] ddpg")[2]
