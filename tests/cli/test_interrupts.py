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
BEGUN = """
import runpy, signal, sys
class Interrupting:
    def find_spec(self, name, *_):
        if name == {moment!r}:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
sys.argv[1:] = ["--version"]
runpy.run_module("switchmt_snn", run_name="__main__")
"""
ANSWERING = """
import signal, sys
from switchmt_snn.cli import entry, run_program
entry._main = lambda argv: signal.raise_signal(signal.SIGINT)
run_program()
"""
WRAPPED = """
import signal
from switchmt_snn.cli import entry, run_program
def called(*_):
    class Name:
        def __set_name__(self, *_):
            signal.raise_signal(signal.SIGINT)
    class Owner:
        name = Name()
entry._called = called
entry.sys.argv[1:] = ["describe"]
run_program()
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


@pytest.mark.parametrize("moment", ["switchmt_snn.cli", "switchmt_snn.cli.entry"])
def test_ctrl_c_in_the_first_import_is_one_line(moment: str) -> None:
    run = _ran(BEGUN.format(moment=moment))
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "switchmt-snn: interrupted\n")


def test_ctrl_c_while_the_first_one_is_answered_ends_it_without_a_traceback() -> None:
    run = _ran(ANSWERING)
    assert (run.returncode, run.stdout, run.stderr) == (-signal.SIGINT, "", "")


def test_ctrl_c_that_python_wraps_in_another_error_is_one_line() -> None:
    run = _ran(WRAPPED)
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "switchmt-snn: interrupted\n")


def test_nothing_is_imported_before_a_ctrl_c_can_be_answered() -> None:
    told = "import importlib.util, sys; known = {*sys.modules}; import switchmt_snn; print({*sys.modules} - known)"
    assert _ran(told).stdout == "{'switchmt_snn'}\n"


@pytest.mark.slow
def test_a_second_ctrl_c_while_the_program_closes_ends_it_without_a_traceback() -> None:
    run = _ran(PROGRAM.format(moment="torch", then=f"{TWICE}; run_program()"))
    assert (run.returncode, run.stderr) == (-signal.SIGINT, "switchmt-snn: interrupted\n")


def test_a_program_that_calls_main_keeps_its_own_way_with_ctrl_c() -> None:
    run = _ran(PROGRAM.format(moment="torch", then=CALLED))
    assert (run.returncode, run.stdout, run.stderr) == (0, "130 True\n", "switchmt-snn: interrupted\n")


def _ran(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run((sys.executable, "-c", program), capture_output=True, text=True, timeout=120)
