"""``python -m switchmt_snn`` is the command ``switchmt-snn``."""

from switchmt_snn.cli import run_program

run_program()
