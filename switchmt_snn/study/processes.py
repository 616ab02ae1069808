"""One ``train`` command in a process of its own: begun, asked to stop, and ended with who began it."""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from switchmt_snn.study.engine import command_of, environment_of

_PR_SET_PDEATHSIG = 1  # prctl.h of Linux


class TrainingProcess:
    """A process that trains; on Linux it saves and ends when the process that began it is killed."""

    def __init__(self, words: Sequence[str], log: Path, threads: int, python_path: str | None = None) -> None:
        """Begin it.

        Args:
            words: what follows ``switchmt-snn``.
            log: its output goes to the end of this file.
            threads: that libraries may begin.
            python_path: PYTHONPATH in place of this process's own.
        """
        own = {} if python_path is None else {"PYTHONPATH": python_path}
        with log.open("ab") as stream:
            self.process = subprocess.Popen(
                command_of(words),
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                env=environment_of(threads) | own,
                start_new_session=True,  # Ctrl-C reaches the study alone, which asks its trials once
                preexec_fn=_stop_with_parent if sys.platform == "linux" else None,
            )

    def poll(self) -> int | None:
        """Its exit code (negative: a signal), or None while it runs."""
        return self.process.poll()

    def ask_to_stop(self) -> None:
        """Let it save a checkpoint and end."""
        self.process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it now; return when it has ended."""
        self.process.kill()
        self.process.wait()


def _stop_with_parent() -> None:
    """In the new process: ask Linux for a SIGTERM when the one that began it ends; the trial then saves and ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
