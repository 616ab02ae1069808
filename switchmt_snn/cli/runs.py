"""``switchmt-snn runs``: the run folders, by the time they began."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from switchmt_snn.cli.parsing import parse, split_one
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class RunsOptions:
    """List the run folders in a folder: method, tasks, steps, status, newest scores, time and size."""

    json: bool = False
    """Print them as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    folder, rest = split_one(RunsOptions, argv, "runs", RunsOptions())
    options = parse(RunsOptions, rest, "runs", RunsOptions())
    from switchmt_snn.runs.folder import RUNS
    from switchmt_snn.runs.listing import list_runs
    from switchmt_snn.viewing.progress_bar import ProgressBars
    from switchmt_snn.viewing.tables import runs_table

    path = Path(folder) if folder is not None else RUNS
    with ProgressBars():
        runs, damaged = list_runs(path)
    for one in damaged:
        print(f"damaged: {one.path.name}: {one.problem}", file=sys.stderr)
    if options.json:
        output.print_json([run.to_dict() for run in runs], indent=1)
    elif runs:
        output.console().print(runs_table(runs))
    else:
        print(f"no run in {path}")
    return 0
