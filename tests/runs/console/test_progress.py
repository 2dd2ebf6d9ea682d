import io
import re
import types

import jax
import pytest
from rich.console import Console

from cmedirl_jax.runs.console import progress
from cmedirl_jax.training.methods import METHODS


@pytest.fixture
def clock(monkeypatch):
    clock = types.SimpleNamespace(now=100.0)
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def plain():
    return Console(file=io.StringIO(), width=40)


def terminal(monkeypatch, width=200, term="xterm-256color"):
    monkeypatch.setenv("TERM", term)
    return Console(file=io.StringIO(), force_terminal=True, width=width)


def compile_for(clock, seconds):
    clock.now += seconds
    jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", seconds)


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


def test_time_spent_on_compiling_is_no_rate(clock):
    """Not at a part's beginning, not amid it, and not in the next part."""
    console = plain()
    with progress.reporter(console, parts=2, total_steps=4_000) as report:
        for name in ("ddpg", "hs-ddpg"):
            report.start(name)
            compile_for(clock, 30.0)
            report.go_on(0)
            for compiling in (40.0, 0.0, 50.0, 0.0):
                if compiling:
                    compile_for(clock, compiling)
                clock.now += 10.0
                report.advance(500, 0.0)
    # 20 ms a step. Each part takes 120 s beside its steps, of which the first line knows 70.
    assert console.file.getvalue().splitlines() == [
        "[1/2] ddpg",
        "[1/2] ddpg: 12% of the run, solved 0%",
        "[1/2] ddpg: 25% of the run, solved 0%, 50 steps/s, 130 s left",
        "[1/2] ddpg: 38% of the run, solved 0%, 170 s left",
        "[1/2] ddpg: 50% of the run, solved 0%, 50 steps/s, 160 s left",
        "[2/2] hs-ddpg",
        "[2/2] hs-ddpg: 62% of the run, solved 0%, 30 s left",
        "[2/2] hs-ddpg: 75% of the run, solved 0%, 50 steps/s, 20 s left",
        "[2/2] hs-ddpg: 88% of the run, solved 0%, 10 s left",
        "[2/2] hs-ddpg: 100% of the run, solved 0%, 50 steps/s, 0 s left",
    ]


def test_what_a_checkpoint_holds_is_neither_measured_nor_left(clock):
    console = plain()
    with progress.reporter(console, parts=1, total_steps=4_000) as report:
        report.start("ddpg")
        clock.now += 30.0
        report.go_on(2_000)
        clock.now += 10.0
        report.advance(1_000, 0.0)
    last = console.file.getvalue().splitlines()[-1]
    assert last == "[1/1] ddpg: 50% of the run, solved 0%, 100 steps/s, 10 s left"


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


@pytest.mark.parametrize("width", [40, 80, 120])
def test_on_a_narrow_terminal_no_word_is_cut(monkeypatch, clock, width):
    for method in METHODS:
        console = terminal(monkeypatch, width)
        with progress.reporter(console, parts=1, total_steps=10**6) as report:
            report.start(f"{method}-n1000, seeds 100 to 199")
            clock.now += 1.0
            report.advance(123_456, 0.5)
        words = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", " ", console.file.getvalue()).split()
        assert {f"{method}-n1000,", "123,456", "199:", "50%,"} <= set(words)


def test_a_terminal_that_cannot_move_its_cursor_has_lines(monkeypatch, clock):
    console = terminal(monkeypatch, term="dumb")
    with progress.reporter(console, parts=1, total_steps=4_000) as report:
        report.start("ddpg")
    assert console.file.getvalue() == "[1/1] ddpg\n"
