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
from switchmt_snn.cli import main, run_program
builtins.__import__ = interrupted
sys.argv = ["switchmt-snn", "describe", "quickstart"]
{then}
"""
CALLED = """
try:
    main()
except SystemExit as stop:
    print(stop.code, signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""
TWICE = "import atexit; atexit.register(signal.raise_signal, signal.SIGINT)"


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["yaml", "tyro", "torch"])
def test_ctrl_c_while_a_command_is_imported_is_one_line(moment: str) -> None:
    run = _ran(PROGRAM.format(moment=moment, then="run_program()"))
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "switchmt-snn: interrupted\n")


@pytest.mark.slow
def test_a_second_ctrl_c_while_the_program_closes_ends_it_without_a_traceback() -> None:
    run = _ran(PROGRAM.format(moment="torch", then=f"{TWICE}; run_program()"))
    assert (run.returncode, run.stderr) == (-signal.SIGINT, "switchmt-snn: interrupted\n")


def test_a_program_that_calls_main_keeps_its_own_way_with_ctrl_c() -> None:
    run = _ran(PROGRAM.format(moment="torch", then=CALLED))
    assert (run.returncode, run.stdout, run.stderr) == (0, "130 True\n", "switchmt-snn: interrupted\n")


def _ran(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run((sys.executable, "-c", program), capture_output=True, text=True, timeout=120)
