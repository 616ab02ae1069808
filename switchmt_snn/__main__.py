"""``python -m switchmt_snn`` is the command ``switchmt-snn``."""

from switchmt_snn.cli import main

main()
