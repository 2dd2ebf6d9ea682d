import io
import os
import subprocess
import sys

import pytest
from rich.console import Console

from cmedirl_jax.runs.console import streams
from tests.support import ROOT


def without_reader():
    reader, writer = os.pipe()
    os.close(reader)
    return writer


def full():
    return os.open("/dev/full", os.O_WRONLY)


DEAD = {"reader gone": without_reader, "disk full": full}


@pytest.mark.parametrize("dead", DEAD)
def test_what_cannot_be_printed_is_done_without(monkeypatch, dead):
    descriptor = DEAD[dead]()
    with os.fdopen(descriptor, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        console = Console(file=streams.dispensable(), width=120)
        for _ in range(3):
            console.print("line")
        # More than the stream's buffer holds.
        console.print("line\n" * 10_000)
        # The descriptor leads elsewhere, so closing the stream has nothing to fail at.
        assert os.readlink(f"/proc/self/fd/{descriptor}") == os.devnull


@pytest.mark.parametrize("dead", DEAD)
def test_python_ends_in_peace_when_nobody_reads(dead):
    script = (
        "import sys; from cmedirl_jax.runs.console import streams\n"
        "print('out'); streams.complain('error'); print('warning', file=sys.stderr, end='')\n"
        "streams.flush(); sys.exit(3)"
    )
    descriptor = DEAD[dead]()
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=ROOT,
        env=os.environ | {"PYTHONUNBUFFERED": ""},
        stdout=descriptor,
        stderr=descriptor,
        check=False,
    )
    os.close(descriptor)
    assert done.returncode == 3


def test_without_standard_output_there_is_nothing_to_print_on(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    assert streams.dispensable() is None
    Console(file=streams.dispensable()).print("line")
    streams.flush()


def test_what_the_encoding_does_not_have_is_replaced(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, "ascii", newline="\n"))
    Console(file=streams.dispensable(), width=120).print("1 ± 2 in run-\udcff")
    assert raw.getvalue() == b"1 ? 2 in run-?\n"


def test_a_terminal_is_still_one(monkeypatch):
    for name in ("TTY_COMPATIBLE", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    controller, terminal = os.openpty()
    with os.fdopen(terminal, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert Console(file=streams.dispensable()).is_terminal
    os.close(controller)
