"""The long campaign: ``python -m tests.fuzz.run config --mutants 10000 --seed 1``; a fault leaves its mutant behind."""

from __future__ import annotations

import argparse
import collections
import resource
import sys
import tempfile
import time
import traceback
from pathlib import Path

from tests.fuzz.formats import FORMATS, mutant_of, outcome


def campaign(name: str, mutants: int, seed: int, kept: Path) -> collections.Counter[str]:
    """Play mutants of a format; counts of ``taken``, ``refused`` and ``fault``."""
    counts: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(seed * 1_000_000, seed * 1_000_000 + mutants):
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("format", choices=[*FORMATS, "all"])
    parser.add_argument("--mutants", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kept", type=Path, default=Path("fuzz-faults"), help="folder for mutants with a fault")
    options = parser.parse_args()
    faults = 0
    for name in FORMATS if options.format == "all" else [options.format]:
        start, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        counts = campaign(name, options.mutants, options.seed, options.kept)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        seconds = time.process_time() - start
        print(
            f"{name}: {options.mutants:,} mutants of seed {options.seed}: {counts['taken']:,} taken, "
            f"{counts['refused']:,} refused, {counts['fault']:,} faults; {seconds:.0f} s of processor time, memory "
            f"grew by {grown:.0f} MiB"
        )
        faults += counts["fault"]
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
