"""How far profiles of one config lie apart: results/profile/spread.csv, and the text about it.

``python -m docs.tools.profile_spread NAME RUN ...`` adds profiled runs of the config in results/profile/NAME.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path

FILE = Path(__file__).parents[2] / "results" / "profile" / "spread.csv"
COLUMNS = ("config", "seed", "processor", "threads", "task", "spikes", "same_action_8_bits", "source")


def rows_of(name: str, run: Path, source: str) -> list[dict[str, str]]:
    """One row per task of a profiled run."""
    profile = json.loads((run / "profile" / "profile.json").read_text())
    environment = json.loads((run / "environment.json").read_text())
    (seed,) = (line.split()[1] for line in (run / "config.yaml").read_text().splitlines() if line.startswith("seed:"))
    machine = {"processor": environment["processor"], "threads": str(environment["torch_threads"])}
    return [
        {"config": name, "seed": seed, **machine, "task": task["task"], "source": source}
        | {"spikes": f"{task['per_decision']['spikes']:.0f}"}
        | {"same_action_8_bits": f"{task['precision'][0]['equal_actions_share']:.4g}"}
        for task in profile["tasks"]
    ]


def spread(name: str, measured: dict[str, float]) -> list[str]:
    """What other runs of a config gave, beside the stored profile's share of equal actions by task."""
    if not FILE.exists():
        return []
    with FILE.open(newline="") as stream:
        found = [row for row in csv.DictReader(stream) if row["config"] == name]
    if not found:
        return [
            "",
            "**One run**: another seed or processor gives other numbers, the shares of equal actions above all.",
        ]
    shares = {
        task: sorted([own, *(float(row["same_action_8_bits"]) for row in found if row["task"] == task)])
        for task, own in measured.items()
    }
    ranges = ", ".join(f"{task} {values[0]:.1%} to {values[-1]:.1%}" for task, values in shares.items())
    runs = 1 + len(found) // len(measured)
    return [
        "",
        f"**Same action with 8-bit weights, over {runs} runs of this config** (`spread.csv`):",
        f"{ranges}.",
        "Trainings part at the first sum that rounds otherwise, and a network this young prefers one action by little:",
        "the share says nothing about 8 bits in general.",
    ]


def main(name: str, runs: Sequence[str]) -> None:
    """Add runs to the file."""
    rows = [row for run in runs for row in rows_of(name, Path(run), "switchmt-snn profile")]
    begins = not FILE.exists()
    with FILE.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, restval="", lineterminator="\n")
        if begins:
            writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
