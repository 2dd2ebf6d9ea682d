import os
import signal
import sys

import pytest

from cmedirl_jax.runs.console import signals
from cmedirl_jax.runs.errors import Interrupted


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_is_noted_and_obeyed_later(number, code):
    before = signal.getsignal(number)
    with signals.noted() as noted:
        assert not noted.came()
        os.kill(os.getpid(), number)
        assert noted.came()
        with pytest.raises(Interrupted, match=number.name) as stopped:
            noted.stop()
    assert stopped.value.exit_code == code
    assert signal.getsignal(number) is before


def test_a_second_signal_acts_at_once(monkeypatch):
    monkeypatch.setattr(signals, "TWICE", 0.0)
    with signals.noted():
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_sent_twice_is_one():
    with signals.noted() as noted:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(Interrupted, match="SIGTERM"):
            noted.stop()


def test_a_signal_is_noted_where_nobody_reads_the_notice():
    before = os.dup(1)
    reader, writer = os.pipe()
    os.close(reader)
    os.dup2(writer, 1)
    try:
        with signals.noted("Stopping") as noted:
            os.kill(os.getpid(), signal.SIGINT)
            assert noted.came()
    finally:
        os.dup2(before, 1)
        os.close(before)
        os.close(writer)


def test_a_notice_goes_into_no_other_file(monkeypatch, capfd):
    monkeypatch.setattr(sys, "__stdout__", None)
    with signals.noted("Stopping") as noted:
        os.kill(os.getpid(), signal.SIGINT)
        assert noted.came()
    assert capfd.readouterr().out == ""


def test_a_signal_acts_at_once_when_there_is_nothing_left_to_save():
    with signals.noted("Stopping") as noted:
        noted.release()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_that_came_before_is_obeyed_then():
    with signals.noted() as noted:
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(Interrupted, match="SIGTERM"):
            noted.release()


def test_handlers_are_put_back_after_an_error():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(ZeroDivisionError), signals.noted():
        1 / 0  # noqa: B018
    assert signal.getsignal(signal.SIGTERM) is before
