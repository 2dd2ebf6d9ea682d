import os
import signal

import pytest

from experiments import interruption
from experiments.interruption import Interrupted


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_is_noted_and_obeyed_later(number, code):
    before = signal.getsignal(number)
    with interruption.noted() as noted:
        assert not noted.came()
        os.kill(os.getpid(), number)
        assert noted.came()
        with pytest.raises(Interrupted, match=number.name) as stopped:
            noted.stop()
    assert stopped.value.exit_code == code
    assert signal.getsignal(number) is before


def test_a_second_signal_acts_at_once(monkeypatch):
    monkeypatch.setattr(interruption, "TWICE", 0.0)
    with interruption.noted():
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_sent_twice_is_one():
    with interruption.noted() as noted:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(Interrupted, match="SIGTERM"):
            noted.stop()


def test_handlers_are_put_back_after_an_error():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(ZeroDivisionError), interruption.noted():
        1 / 0  # noqa: B018
    assert signal.getsignal(signal.SIGTERM) is before
