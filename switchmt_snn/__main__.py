"""``python -m switchmt_snn`` is the command ``switchmt-snn``; the installed script enters here, too."""

import sys

try:
    from switchmt_snn.cli import run_program
except KeyboardInterrupt:  # while the entry point itself is imported; from then on it answers
    sys.stderr.write("switchmt-snn: interrupted\n")
    sys.exit(130)

if __name__ == "__main__":
    run_program()
