"""The command line: parse, call, print. No logic."""

from switchmt_snn.cli.entry import main

__all__ = ["main"]
