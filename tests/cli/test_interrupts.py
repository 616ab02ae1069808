"""Ctrl-C at any moment of a command: one line, exit code 130, no traceback."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

PROGRAM = """
import builtins, signal, sys
real = builtins.__import__
def interrupted(name, *rest, **more):
    if name.split(".")[0] == {moment!r}:
        signal.raise_signal(signal.SIGINT)
    return real(name, *rest, **more)
from switchmt_snn.cli import main
builtins.__import__ = interrupted
{twice}
main(["describe", "quickstart"])
"""
TWICE = "import atexit; atexit.register(signal.raise_signal, signal.SIGINT)"


@pytest.mark.parametrize("moment", ["yaml", "tyro", "torch"])
def test_ctrl_c_while_a_command_is_imported_is_one_line(moment: str) -> None:
    run = _ran(PROGRAM.format(moment=moment, twice=""))
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "switchmt-snn: interrupted\n")


def test_a_second_ctrl_c_while_the_program_closes_ends_it_without_a_traceback() -> None:
    run = _ran(PROGRAM.format(moment="torch", twice=TWICE))
    assert (run.returncode, run.stderr) == (-signal.SIGINT, "switchmt-snn: interrupted\n")


def _ran(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run((sys.executable, "-c", program), capture_output=True, text=True, timeout=120)
