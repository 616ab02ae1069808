"""Requests to stop, also of code that hangs."""

from __future__ import annotations

import os
import signal
import time

import pytest

from switchmt_snn.errors import TrainingFailed
from switchmt_snn.runs import signals
from switchmt_snn.runs.signals import stop_requests

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="signals of POSIX")


def send(number: int) -> None:
    os.kill(os.getpid(), number)
    time.sleep(0.01)


def _ask(*numbers: int, then_sleep_s: float = 0) -> None:
    with stop_requests():
        for number in numbers:
            send(number)
        time.sleep(then_sleep_s)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_request_only_asks(number: int) -> None:
    before = signal.getsignal(number)
    with stop_requests() as requested:
        assert not requested()
        send(number)
        assert requested()
        assert signal.getitimer(signal.ITIMER_REAL) == (0, 0), "a whole step has ended"
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM])
def test_a_second_request_interrupts(second: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "_SAME_REQUEST_S", 0.0)
    with pytest.raises(KeyboardInterrupt):
        _ask(signal.SIGTERM, second)
    assert signal.getitimer(signal.ITIMER_REAL) == (0, 0)


def test_one_sigterm_that_comes_twice_is_one_request() -> None:
    with stop_requests() as requested:
        send(signal.SIGTERM)
        send(signal.SIGTERM)
        assert requested()


def test_a_step_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "MOST_WAIT_S", 0.1)
    with pytest.raises(TrainingFailed, match=r"no step ended within 0\.1 s after a request to stop"):
        _ask(signal.SIGTERM, then_sleep_s=60)
