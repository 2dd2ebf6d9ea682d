import signal
import subprocess

import jax
import pytest

from cmedirl_jax.runs.cluster import processes


class Ended(BaseException):
    """In place of the process."""


@pytest.fixture
def ended(monkeypatch):
    def end(code):
        raise Ended(code)

    monkeypatch.setattr(processes.os, "_exit", end)


def failing(error):
    def run():
        raise error

    return run


def test_a_process_that_fails_alone_says_why_and_ends_at_once(ended, capsys):
    with pytest.raises(Ended, match="1"):
        processes.guarded("run_grid", failing(ZeroDivisionError("by nothing")))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "Traceback (most recent call last):"
    assert lines[-1] == "ZeroDivisionError: by nothing"


@pytest.mark.parametrize(
    "error",
    [
        jax.errors.JaxRuntimeError("FAILED_PRECONDITION: Gloo AllGather failed"),
        jax.errors.JaxRuntimeError("UNAVAILABLE: Coordination service"),
        ValueError("INTERNAL: NCCL operation"),
    ],
)
def test_a_process_that_lost_another_says_so_and_ends_at_once(ended, capsys, error):
    with pytest.raises(Ended, match="1"):
        processes.guarded("run_grid", failing(error))
    assert capsys.readouterr().err == f"run_grid: {processes.GONE}\n"


def test_a_process_that_could_not_write_ends_at_once(ended):
    with pytest.raises(Ended, match="1"):
        processes.guarded("run_grid", lambda: 1)


@pytest.mark.parametrize("code", [0, 2, 130, 143])
def test_what_all_agree_on_is_returned(ended, code):
    assert processes.guarded("run_grid", lambda: code) == code


class Child:
    """A child that is told `sent` by way of its parent, and ends with `code`."""

    def __init__(self, code, sent=()):
        self.code, self.sent, self.received = code, sent, []

    def wait(self):
        for number in self.sent:
            signal.raise_signal(number)
        return self.code

    def send_signal(self, number):
        self.received.append(number)


@pytest.fixture
def supervised(monkeypatch):
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def supervise(child):
        monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: child)
        return processes.supervise("experiments.run_grid", [])

    yield supervise
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_parent_passes_signals_on_and_returns_what_comes_of_them(supervised, capsys):
    child = Child(130, sent=(signal.SIGINT, signal.SIGTERM))
    assert supervised(child) == 130
    assert child.received == [signal.SIGINT, signal.SIGTERM]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("code", "shown", "line"),
    [
        (-signal.SIGABRT, 1, f"run_grid: {processes.GONE}"),
        (-signal.SIGSEGV, 139, "run_grid: ended by SIGSEGV"),
        (-signal.SIGKILL, 137, "run_grid: ended by SIGKILL"),
    ],
)
def test_a_parent_says_what_ended_its_child(supervised, capsys, code, shown, line):
    assert supervised(Child(code)) == shown
    assert capsys.readouterr().err == line + "\n"
