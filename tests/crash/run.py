"""Every crash point of every command: ``python -m tests.crash.run all``; ``--every 5`` takes each fifth."""

from __future__ import annotations

import argparse
import collections
import sys
import tempfile
import time
from pathlib import Path

from tests.crash.points import COMMANDS, outcome, prepared, products, run_until, words
from tests.fuzz.run import environment, record


def main() -> int:
    """Play the points; the exit code is 1 if one of them ends otherwise than an uninterrupted command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=[*COMMANDS, "all"])
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--record", type=Path, help="JSON file whose row of the command is replaced")
    options = parser.parse_args()
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepared("train", folder / "finished", None)
        run_until(words("train", folder / "finished"), folder / "finished", None)
        for command in COMMANDS if options.command == "all" else [options.command]:
            started = time.monotonic()
            prepared(command, folder / "whole", folder / "finished")
            code, operations = run_until(words(command, folder / "whole"), folder / "whole", None)
            assert code == 0, (folder / "whole.log").read_text()
            expected = products(folder / "whole")
            points = range(options.first, operations + 1, options.every)
            counts: collections.Counter[str] = collections.Counter()
            for point in points:
                seen = outcome(command, folder / "crashed", folder / "finished", expected, point)
                counts[seen] += 1
                if seen != "same":
                    print(f"{command}, operation {point} of {operations}: {seen}", file=sys.stderr)
            wrong += len(points) - counts["same"]
            print(
                f"{command}: {len(points)} of {operations} file operations, {counts['same']} end as uninterrupted; "
                f"{time.monotonic() - started:.0f} s"
            )
            if options.record is not None:
                row = {"operations": operations, "crashed_at": len(points), "same": counts["same"]}
                record(options.record, command, {**row, "environment": environment()})
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
