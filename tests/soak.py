"""A process over hours: ``python -m tests.soak PID RUN --out soak.csv`` notes its memory, threads and open files.

A row every minute, until the process ends; rows are added to a file that is there, so a run that is continued goes on.
Linux only (/proc).
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

COLUMNS = ("unix_s", "rss_bytes", "threads", "open_files", "run_folder_bytes")
EVERY_S = 60.0


def sample(process: Path, run: Path) -> dict[str, int] | None:
    """A row; None if the process has ended."""
    try:
        status = dict(line.split(":", 1) for line in (process / "status").read_text().splitlines())
        open_files = len(list((process / "fd").iterdir()))
    except (OSError, ProcessLookupError):
        return None
    if "VmRSS" not in status:  # ended, and not yet waited for
        return None
    return {
        "unix_s": int(time.time()),
        "rss_bytes": 1024 * int(status["VmRSS"].split()[0]),
        "threads": int(status["Threads"]),
        "open_files": open_files,
        "run_folder_bytes": sum(path.stat().st_size for path in run.rglob("*") if path.is_file()),
    }


def main() -> None:
    """Sample until the process ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pid", type=int)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    if not options.out.exists():
        options.out.write_text(",".join(COLUMNS) + "\n")
    while (row := sample(Path("/proc") / str(options.pid), options.run)) is not None:
        with options.out.open("a", newline="") as stream:
            csv.DictWriter(stream, COLUMNS, lineterminator="\n").writerow(row)
        time.sleep(EVERY_S)


if __name__ == "__main__":
    main()
