"""Ctrl-C and SIGTERM as requests to stop at the next whole step."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from switchmt_snn.errors import TrainingFailed

MOST_WAIT_S = 300.0
"""A step that takes longer after a request to stop, an environment that hangs, is ended; writing a checkpoint is
shorter."""
_SAME_REQUEST_S = 1.0
"""A SIGTERM so soon after the first request is the same one: a process and its group may both be sent it."""


@contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Within it, the first SIGINT or SIGTERM only asks to stop at the next whole step; a second one interrupts.

    Yields:
        Whether a stop was asked for. It is called after every whole step.

    Raises:
        KeyboardInterrupt: a second request.
        TrainingFailed: no step ended within ``MOST_WAIT_S`` after a request.
    """
    asked: list[float] = []

    def ask(number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if asked and (number == signal.SIGINT or now - asked[0] > _SAME_REQUEST_S):
            raise KeyboardInterrupt
        if not asked:
            asked.append(now)
            _alarm_after(MOST_WAIT_S)

    def give_up(number: int, frame: FrameType | None) -> None:
        raise TrainingFailed(
            f"no step ended within {MOST_WAIT_S:g} s after a request to stop, expected an environment that answers; "
            "what was saved before is kept (train: --run goes on from the last whole checkpoint)"
        )

    def requested() -> bool:
        if asked:
            _alarm_after(0)
        return bool(asked)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    handlers = {signal.SIGINT: ask, signal.SIGTERM: ask} | ({signal.SIGALRM: give_up} if _HAS_ALARM else {})
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield requested
    finally:
        if asked:
            _alarm_after(0)
        for number, handler in before.items():
            signal.signal(number, handler)


_HAS_ALARM = hasattr(signal, "SIGALRM")  # Windows has none


def _alarm_after(seconds: float) -> None:
    if _HAS_ALARM:
        signal.setitimer(signal.ITIMER_REAL, seconds)
