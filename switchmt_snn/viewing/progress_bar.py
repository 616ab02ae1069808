"""Progress of every command but training, on stderr: bars in a terminal, now and then a plain line elsewhere."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from switchmt_snn.drawing.numbers import duration
from switchmt_snn.machine.progress import Work, listening
from switchmt_snn.viewing.output import console

FIRST_LINE_S = 2.0
"""Work that takes less says nothing in a plain log."""
LINES_EVERY_S = 15.0


class ProgressBars(AbstractContextManager["ProgressBars"]):
    """Shows the work of the commands that run inside ``with``; see ``switchmt_snn.machine.progress``."""

    def __init__(self, on: Console | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self.console = on or console(stderr=True)
        self._clock = clock
        self._bars: Progress | None = None
        self._shown: dict[int, TaskID] = {}
        self._began_s: dict[int, float] = {}
        self._due_s: dict[int, float] = {}
        self._lock = threading.Lock()
        self._listening = listening(self)

    def __enter__(self) -> ProgressBars:
        self._listening.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()
        self._listening.__exit__(kind, error, trace)

    def begun(self, work: Work) -> None:
        """Open a bar, or note the time."""
        with self._lock:
            self._began_s[id(work)] = self._clock()
            self._due_s[id(work)] = self._began_s[id(work)] + FIRST_LINE_S
            if self.console.is_terminal:
                if self._bars is None:
                    self._bars = _bars(self.console)
                    self._bars.start()
                self._shown[id(work)] = self._bars.add_task(work.what, total=work.total, unit=work.unit)

    def advanced(self, work: Work) -> None:
        """Move the bar, or print a line if it is time."""
        if self._bars is not None:
            self._bars.update(self._shown[id(work)], completed=work.done)
            return
        now_s = self._clock()
        with self._lock:
            if now_s < self._due_s[id(work)] or work.done == work.total:
                return
            self._due_s[id(work)] = now_s + LINES_EVERY_S
        self.console.print(_line(work, now_s - self._began_s[id(work)]), highlight=False, soft_wrap=True)

    def ended(self, work: Work) -> None:
        """Take the bar away; after the last one the terminal is as it was."""
        with self._lock:
            del self._began_s[id(work)], self._due_s[id(work)]
            if self._bars is not None:
                self._bars.remove_task(self._shown.pop(id(work)))
        if not self._shown:
            self._close()

    def _close(self) -> None:
        if self._bars is not None:
            self._bars.stop()
            self._bars = None


def _bars(on: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]}", markup=False),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=on,
        transient=True,
    )


def _line(work: Work, wall_s: float) -> str:
    left_s = wall_s * (work.total - work.done) / work.done
    return f"{work.what}: {work.done:,} of {work.total:,} {work.unit}, left {duration(left_s)}"
