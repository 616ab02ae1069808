"""How far a long piece of work is, told to whoever listens. In a library nobody does, and nothing is printed.

The command line listens (``switchmt_snn.viewing.progress_bar``). A program of its own may::

    with listening(Mine()):
        evaluate("runs/mine")
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Protocol


@dataclass
class Work:
    """A piece of work that is going on.

    Attributes:
        what: in words, as ``playing pong``.
        total: how much there is to do.
        unit: what is counted, in the plural.
        done: how much of it is done.
    """

    what: str
    total: int
    unit: str
    done: int = 0
    listener: Listener | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def advance(self, count: int = 1) -> None:
        """So many more are done; may be called from any thread."""
        if self.listener is None or count == 0:
            return
        with self._lock:
            self.done = min(self.total, self.done + count)
            self.listener.advanced(self)


class Listener(Protocol):
    """Shows work. ``advanced`` may come from any thread, for one piece of work never twice at a time."""

    def begun(self, work: Work) -> None:
        """Work begins."""

    def advanced(self, work: Work) -> None:
        """``work.done`` has grown."""

    def ended(self, work: Work) -> None:
        """Work has ended, finished or not."""


_listener: ContextVar[Listener | None] = ContextVar("progress listener", default=None)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Until it ends, work that begins in this thread is told to the listener."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def progress_of(what: str, total: int, unit: str) -> Iterator[Work]:
    """A piece of work: its ``advance`` says how much more was done.

    Args:
        what: in words, as ``playing pong``.
        total: how much there is to do.
        unit: what is counted, in the plural.

    Example::

        with progress_of("counting", total=3, unit="decisions") as work:
            for _ in range(3):
                work.advance()
    """
    work = Work(what, total, unit, listener=_listener.get())
    if work.listener is not None:
        work.listener.begun(work)
    try:
        yield work
    finally:
        if work.listener is not None:
            work.listener.ended(work)
