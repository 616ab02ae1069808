"""The command line: parse, call, print. No logic."""

from switchmt_snn.cli.entry import main, run_program

__all__ = ["main", "run_program"]
