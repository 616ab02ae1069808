"""The long campaign: ``python -m tests.fuzz.run config --mutants 10000 --seed 1``; a fault leaves its mutant behind.

``--record results/reliability/campaigns.json`` keeps the counts; ``python -m docs.generate`` makes the table of them.
``--first 5000`` begins at mutant 5,000: with ``--record`` it continues the campaign of the same seed that ended there.
"""

from __future__ import annotations

import argparse
import collections
import importlib.metadata
import json
import platform
import resource
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

from tests.fuzz.formats import FORMATS, mutant_of, outcome


def campaign(name: str, mutants: int, seed: int, kept: Path, first: int = 0) -> collections.Counter[str]:
    """Play mutants of a format from number ``first`` of a seed on; counts of ``taken``, ``refused`` and ``fault``."""
    counts: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(seed * 1_000_000 + first, seed * 1_000_000 + first + mutants):
            content = mutant_of(name, number)
            try:
                line = outcome(name, Path(folder), content, number)
                counts["taken" if line == "taken" else "refused"] += 1
            except Exception:
                counts["fault"] += 1
                kept.mkdir(parents=True, exist_ok=True)
                (kept / f"{name}-{number}").write_bytes(content)
                print(f"mutant {number}: {traceback.format_exc()}", file=sys.stderr)
    return counts


def environment() -> dict[str, str]:
    """What the campaign ran with."""
    packages = ("torch", "numpy", "h5py", "onnx", "onnxruntime", "nir")
    versions = {name: importlib.metadata.version(name) for name in packages}
    return {
        "date": time.strftime("%Y-%m-%d"),
        "platform": platform.platform(),
        "python": platform.python_version(),
    } | versions


def record(path: Path, key: str, row: dict[str, Any]) -> None:
    """Replace a row of a JSON file."""
    rows = json.loads(path.read_text()) if path.exists() else {}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(dict(sorted({**rows, key: row}.items())), indent=1) + "\n")


def continued(path: Path, name: str, row: dict[str, Any], first: int) -> dict[str, Any]:
    """A row that includes the one of the same seed's first mutants.

    Raises:
        ValueError: the file has no such row.
    """
    before = json.loads(path.read_text()).get(name, {}) if path.exists() else {}
    if (before.get("seed"), before.get("mutants")) != (row["seed"], first):
        raise ValueError(f"{path} has no row of the first {first} mutants of {name} with seed {row['seed']}")
    sums = {key: before[key] + row[key] for key in ("mutants", "taken", "refused", "fault", "processor_s")}
    return {**row, **sums, "memory_grew_mib": max(before["memory_grew_mib"], row["memory_grew_mib"])}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("format", choices=[*FORMATS, "all"])
    parser.add_argument("--mutants", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kept", type=Path, default=Path("fuzz-faults"), help="folder for mutants with a fault")
    parser.add_argument("--record", type=Path, help="JSON file whose row of the format is replaced")
    options = parser.parse_args()
    faults = 0
    for name in FORMATS if options.format == "all" else [options.format]:
        start, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        counts = campaign(name, options.mutants, options.seed, options.kept, options.first)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        seconds = time.process_time() - start
        print(
            f"{name}: {options.mutants:,} mutants of seed {options.seed}: {counts['taken']:,} taken, "
            f"{counts['refused']:,} refused, {counts['fault']:,} faults; {seconds:.0f} s of processor time, memory "
            f"grew by {grown:.0f} MiB"
        )
        faults += counts["fault"]
        if options.record is not None:
            row = {
                "mutants": options.mutants,
                "seed": options.seed,
                **{key: counts[key] for key in ("taken", "refused", "fault")},
                "processor_s": round(seconds),
                "memory_grew_mib": round(grown),
                "environment": environment(),
            }
            record(options.record, name, continued(options.record, name, row, options.first) if options.first else row)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
