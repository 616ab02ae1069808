"""This checkout against an older commit: the update step and the start of the program, in turns.

``python -m benchmarks.against COMMIT [--rounds 5] [--json]``. The commit is cloned into a temporary folder. In every
round each of the two runs ``benchmarks.update_step`` for the plain loop and the native updates, and starts the program
three times; who begins changes from round to round. The plain loop is the same code in both, so its ratio says how
quiet the machine was. Each round's numbers stand on stderr as soon as they are measured; a processor without bfloat16
instructions is not asked for them.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.measure import environment
from switchmt_snn.machine.devices import has_bfloat16

ROOT = Path(__file__).parents[1]
UPDATES = "import benchmarks.update_step as step; step.matmul_gflops = lambda *_: 1.0; step.main()"
"""The checkout's own benchmark without the machine's ceiling, which takes minutes where bfloat16 is imitated."""
VARIANTS = ("plain loop", "ours, float32, native")
BFLOAT16_VARIANT = "ours, bfloat16, native"  # on processors that have the instructions
STARTS = {"--version": ("-m", "switchmt_snn", "--version"), "train --help": ("-m", "switchmt_snn", "train", "--help")}


def updates_ms(checkout: Path) -> dict[str, float]:
    """Median milliseconds of an update of each variant, measured by the checkout's own benchmark."""
    variants = (*VARIANTS, BFLOAT16_VARIANT) if has_bfloat16(torch.device("cpu")) else VARIANTS
    command = ("-c", UPDATES, "--repeats", "8", "--json", "--only", *variants)
    report = json.loads(_python(checkout, *command))
    return {name: row["median_ms"] for name, row in report["variants"].items()}


def starts_ms(checkout: Path) -> dict[str, float]:
    """Shortest of three times, in milliseconds, from the start of each command to its end."""
    found = {}
    for name, command in STARTS.items():
        times = []
        for _ in range(3):
            begin = time.perf_counter()
            _python(checkout, *command)
            times.append(1000 * (time.perf_counter() - begin))
        found[f"start: {name}"] = min(times)
    return found


def _python(checkout: Path, *arguments: str) -> str:
    environ = {**os.environ, "PYTHONPATH": str(checkout)}
    run = subprocess.run((sys.executable, *arguments), cwd=checkout, env=environ, capture_output=True, text=True)
    if run.returncode:
        raise SystemExit(f"{' '.join(arguments)} failed in {checkout}: {run.stderr.strip().splitlines()[-1]}")
    return run.stdout


def compare(commit: str, rounds: int) -> dict[str, Any]:
    """Medians over rounds of what both need, and of the ratio within a round."""
    with tempfile.TemporaryDirectory() as folder:
        older = Path(folder) / "older"
        subprocess.run(("git", "clone", "-q", ROOT, older), check=True)
        subprocess.run(("git", "-C", older, "checkout", "-q", commit), check=True)
        measured: list[dict[str, dict[str, float]]] = []
        for number in range(rounds):
            checkouts = {"older": older, "this": ROOT}
            order = list(checkouts) if number % 2 == 0 else list(checkouts)[::-1]
            measured.append({who: updates_ms(checkouts[who]) | starts_ms(checkouts[who]) for who in order})
            print(f"round {number + 1} of {rounds}: {json.dumps(measured[-1])}", file=sys.stderr, flush=True)
    rows = []
    for name in measured[0]["this"]:
        ratios = [each["this"][name] / each["older"][name] for each in measured]
        medians = {f"{who}_ms": statistics.median(each[who][name] for each in measured) for who in ("older", "this")}
        rows.append({"what": name, **medians, "ratio": statistics.median(ratios), "range": [min(ratios), max(ratios)]})
    return {"environment": environment(), "commit": commit, "rounds": rounds, "rows": rows}


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", metavar="COMMIT", help="the older commit of this repository")
    parser.add_argument("--rounds", type=int, default=5, help="measurements of each")
    parser.add_argument("--json", action="store_true", help="everything as JSON")
    arguments = parser.parse_args()
    found = compare(arguments.commit, arguments.rounds)
    if arguments.json:
        print(json.dumps(found, indent=1))
        return
    for row in found["rows"]:
        low, high = row["range"]
        times = f"{row['older_ms']:9.1f} ms {row['this_ms']:9.1f} ms"
        print(f"{row['what']:28s} {times}  {row['ratio']:.3f} ({low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
