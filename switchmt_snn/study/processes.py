"""One command of the program in a process of its own: begun, asked to stop, and ended with who began it."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from switchmt_snn.runs.files import writing

BEGINS = "--- a process begins"
"""The line of a log before what each process says: the last words of one are not those of an earlier one."""
_PR_SET_PDEATHSIG = 1  # prctl.h of Linux
_PRCTL = ctypes.CDLL(None).prctl if sys.platform == "linux" else None  # found here: the new process only calls it


class ProgramProcess:
    """A process of this program; on Linux it saves and ends when the process that began it is killed."""

    def __init__(self, words: Sequence[str], log: Path, threads: int, python_path: str | None = None) -> None:
        """Begin it.

        Args:
            words: what follows ``switchmt-snn``.
            log: its output goes to the end of this file.
            threads: that libraries may begin.
            python_path: PYTHONPATH in place of this process's own.
        """
        own = {} if python_path is None else {"PYTHONPATH": python_path}
        with writing(log), log.open("ab") as stream:
            stream.write(f"{BEGINS}\n".encode())
            stream.flush()
            self.process = subprocess.Popen(
                _command_of(words),
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                env=_environment_of(threads) | own,
                start_new_session=True,  # Ctrl-C reaches the study alone, which asks its trials once
                preexec_fn=None if _PRCTL is None else _stop_with_parent,
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
    assert _PRCTL is not None
    _PRCTL(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _command_of(words: Sequence[str]) -> list[str]:
    """A command of this program, by this Python."""
    return [sys.executable, "-m", "switchmt_snn", *words]


def _environment_of(threads: int) -> dict[str, str]:
    """The environment of a trial's process: no library begins more threads than the trial has."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {**os.environ, **dict.fromkeys(names, str(threads))}
