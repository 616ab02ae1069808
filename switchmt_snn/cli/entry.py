"""The entry point of ``switchmt-snn``: finds the command, and turns errors into one line and an exit code."""

from __future__ import annotations

import signal
import sys
from contextlib import nullcontext
from importlib import import_module

from switchmt_snn import __version__

USAGE = """\
usage: switchmt-snn COMMAND [options]

  train [CONFIG]      train (CONFIG: a YAML file or a preset; default: quickstart), or continue the run of --run DIR
  evaluate [RUN]      play a run's agent and the random policy under a stated protocol (default: newest run)
  play [RUN]          record a video of a run's agent beside its spikes, Q-values and gains (default: newest run)
  export [RUN]        write ONNX and NIR files with a model card, and prove that they decide alike (default: newest run)
  profile [RUN ...]   spikes, operations, energy and chips on recorded play, with a report (default: newest run)
  report [RUN]        plot curves, switches, layers and scores on one HTML page (default: newest run)
  compare RUN RUN ... the same of several runs side by side, seeds as bands
  study CONFIG        many runs: variants, grids and seeds from one YAML file, each a plain run; resumable
  replay-policies [RUN]  at which episode end each policy would have left the visits of a run (default: newest run)
  runs [FOLDER]       list the run folders: method, tasks, steps, status, scores and size (default: runs/)
  pack [RUN]          a run to give away: weights, model card, config, logs, no replay (default: newest run)
  describe [CONFIG]   layers, parameters, operations and memory of the seven methods, before anything runs
  check-env ID ...    what an environment is taken for, how it plays, and why training would refuse it
  doctor              versions, games and devices of this installation

  switchmt-snn COMMAND --help shows a command's options; --version the version.
  Exit codes: 0 done, 1 the run failed, 2 wrong use, 130 stopped by Ctrl-C (the same command with --run continues).
"""

COMMANDS = (
    "train",
    "evaluate",
    "play",
    "export",
    "profile",
    "report",
    "compare",
    "study",
    "replay-policies",
    "runs",
    "pack",
    "describe",
    "check-env",
    "doctor",
)
"""Each is the function ``command`` of the file of its name, which is imported when it is called for."""

_INTERRUPTED = 130


def main(argv: list[str] | None = None) -> None:
    """Entry point of ``switchmt-snn``; exits with a code that USAGE lists."""
    sys.exit(_main(sys.argv[1:] if argv is None else argv))


def run_program() -> None:
    """The process ``switchmt-snn``: ``main``, and a second Ctrl-C ends what is still closing, without a traceback.

    A program that calls ``main`` keeps its own way with Ctrl-C.
    """
    try:
        main()
    except SystemExit as stop:
        if stop.code == _INTERRUPTED:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        raise
    except KeyboardInterrupt:  # while ``main`` begins, or answers the first
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.raise_signal(signal.SIGINT)


def _main(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(USAGE, end="")
        return 0 if argv else 2
    if argv[0] == "--version":
        print(f"switchmt-snn {__version__}")
        return 0
    try:
        return _called(argv[0], argv[1:])
    except (KeyboardInterrupt, RuntimeError) as error:  # also of the imports
        if isinstance(error, RuntimeError) and not isinstance(error.__cause__, KeyboardInterrupt):
            raise  # a Ctrl-C while a class is made (__set_name__) is the cause of one, up to Python 3.11
        print("switchmt-snn: interrupted", file=sys.stderr)
        return _INTERRUPTED


def _called(name: str, options: list[str]) -> int:
    from switchmt_snn.errors import ConfigError, SwitchMTError, did_you_mean
    from switchmt_snn.machine.program import runnable
    from switchmt_snn.viewing.output import each_warning_once, json_only, speak_any_encoding

    speak_any_encoding()
    try:
        if name not in COMMANDS:
            raise ConfigError(f"unknown command {name!r}{did_you_mean(name, COMMANDS)}")
        command = import_module(f"switchmt_snn.cli.{name.replace('-', '_')}").command
        with each_warning_once(), json_only() if "--json" in options else nullcontext():
            return int(command(options))
    except SwitchMTError as error:
        print(f"switchmt-snn: {runnable(str(error))}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        print(
            f"switchmt-snn: the system refused ({error}), expected readable files and room on the disk", file=sys.stderr
        )
        return 1
