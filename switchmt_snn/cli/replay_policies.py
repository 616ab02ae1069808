"""``switchmt-snn replay-policies``: when each switching policy would have left the visits of a finished run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from switchmt_snn.cli.parsing import parse, split_one
from switchmt_snn.runs.files import write_atomically
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class ReplayOptions:
    """For each visit of a finished run: at which episode end would each switching policy have said switch?

    Nothing is trained. What would have followed is not known: the policy would have collected other data. Settings are
    those of the run, unless --set changes them.
    """

    policy: tuple[str, ...] = ()
    """Policies, as switching.policy takes them. Default: all that the run's logs can answer for."""
    set: tuple[str, ...] = ()
    """Thresholds in place of the run's, each as KEY=VALUE: switching.plateau_t=0.5."""
    out: Path | None = None
    """Also write a CSV file with a row for each policy and visit."""
    trust: bool = False
    """Import modules that the run names, although you did not make it: this runs their code."""
    json: bool = False
    """Print summaries and rows as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    name, rest = split_one(ReplayOptions, argv, "replay-policies", ReplayOptions())
    options = parse(ReplayOptions, rest, "replay-policies", ReplayOptions())
    from switchmt_snn.runs.packing import open_run
    from switchmt_snn.study.replayed import csv_text, replay_policies, replay_table
    from switchmt_snn.viewing.progress_bar import ProgressBars

    with ProgressBars():
        replayed = replay_policies(open_run(name), options.policy, options.set)
    if options.out is not None:
        write_atomically(options.out, csv_text(replayed).encode(), "--out")
    if options.json:
        output.print_json(replayed.to_dict(), indent=1)
    else:
        output.console().print(replay_table(replayed))
        if options.out is not None:
            print(options.out)
    return 0
