"""``switchmt-snn pack``: a run without its replay, to give away."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from switchmt_snn.cli.parsing import parse, split_one


@dataclass(frozen=True)
class PackOptions:
    """Copy what others need of a run: config, logs, evaluations and weights, without the replay.

    Every command that reads a run takes the copy; training cannot be continued from it.
    """

    out: Path | None = None
    """The new folder (default: packed/ with the run's name)."""
    checkpoint: Literal["last", "best"] = "last"
    """Which weights."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    run, rest = split_one(PackOptions, argv, "pack", PackOptions())
    options = parse(PackOptions, rest, "pack", PackOptions())
    from switchmt_snn.runs.packing import open_run, pack

    folder = open_run(run).path
    packed = pack(folder, options.out or Path("packed") / folder.resolve().name, options.checkpoint)
    size = sum(path.stat().st_size for path in packed.rglob("*") if path.is_file())
    print(f"{packed} ({size / 2**20:.1f} MiB)")
    return 0
