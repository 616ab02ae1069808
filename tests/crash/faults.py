"""Commands on a disk that is full or broken: every system call that writes below their folder fails once.

    python -m tests.crash.faults all --every 5

``full``: from that call on nothing has room (ENOSPC), as on a full disk. ``broken``: that call fails, once (EIO). A
library that is preloaded (``faults.c``) lets them fail, so writes by HDF5 and other libraries count, too.
"""

from __future__ import annotations

import argparse
import collections
import ctypes
import errno
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.crash.points import COMMANDS, differing, prepared, products, run_forked, run_until, words
from tests.fuzz.run import environment, record

SOURCE = Path(__file__).with_name("faults.c")
FAULTS = {"full": (errno.ENOSPC, True), "broken": (errno.EIO, False)}
"""The error, and whether it stays."""
_TEMPORARY = re.compile(r"\.tmp\b|/\.|/tmp")
_DECORATED = re.compile(r"/\.([^/]+?)\.([0-9a-f]{6}-[0-9]+-[0-9a-f]{6}-[0-9a-f]{6}|[0-9a-z_]{8})\.tmp\b")
_UNNEEDED = ("mkdir", "open unnamed")
"""Calls that may fail: the folder was there; Python then takes a temporary file with a name."""
_NEEDLESS = "no report: "
"""How the line begins by which a training says that it ended well, but for its page."""


def built(folder: Path) -> Path:
    """The library, built into a folder."""
    library = folder / "faults.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, SOURCE, "-ldl"], check=True)
    return library


def run_with_fault(argv: list[str], folder: Path, point: int, fault: str) -> tuple[int, dict[str, Any]]:
    """Run a command in a fork whose writing call ``point`` fails (0: none does).

    Returns:
        Its exit code; ``calls``: those that it made; ``call`` and ``path``: what failed.
    """
    number, stays = FAULTS[fault]
    (folder / "temporary").mkdir()

    def begin(writing: int) -> Callable[[], str]:
        library = ctypes.CDLL(None)
        library.faults_calls.restype = ctypes.c_long
        library.faults_call.restype = library.faults_path.restype = ctypes.c_char_p
        tempfile.tempdir = str(folder / "temporary")
        library.faults_begin(f"{folder}/".encode(), ctypes.c_long(point), number, int(stays))
        return lambda: json.dumps(
            {
                "calls": library.faults_calls(),
                "call": library.faults_call().decode(),
                "path": library.faults_path().decode(),
            }
        )

    code, said = run_forked(argv, folder, begin)
    return code, json.loads(said) if said else {}


def outcome(command: str, folder: Path, finished: Path, expected: dict[str, Any], point: int, fault: str) -> str:
    """Let a call fail, run the command again, and compare; ``same``, or what is wrong."""
    prepared(command, folder, finished)
    log = folder.parent / f"{folder.name}.log"
    log.unlink(missing_ok=True)
    code, facts = run_with_fault(words(command, folder), folder, point, fault)
    text = log.read_text("utf-8", "replace")
    where = f"{facts.get('call')} {facts.get('path', '').replace(str(folder), '')}"
    wrong = _wrong(command, code, text, facts, os.strerror(FAULTS[fault][0]), folder)
    left = [path for path in map(str, folder.rglob("*")) if _TEMPORARY.search(path.removeprefix(str(folder)))]
    if left:
        wrong = [*wrong, f"left {', '.join(one.replace(str(folder), '') for one in left)}"]
    if wrong:
        return f"{where}: {'; '.join(wrong)}"
    if code != 0 or not _unneeded(command, facts):
        code, _ = run_until(words(command, folder), folder, None)
    if code != 0:
        return f"{where}: the same command again ends with exit code {code}: {log.read_text()[-300:]!r}"
    different = differing(expected, products(folder))
    return f"{where}: other content: {', '.join(different)}" if different else "same"


def _asks(command: str, facts: dict[str, Any]) -> bool:
    """Whether the call opens the lock of a run only to see whether somebody trains there."""
    return str(facts["path"]).endswith("/run.lock") and not command.startswith(("train", "study"))


def _unneeded(command: str, facts: dict[str, Any]) -> bool:
    return facts["call"] in _UNNEEDED or _asks(command, facts)


def _wrong(command: str, code: int, text: str, facts: dict[str, Any], cause: str, folder: Path) -> list[str]:
    """What is wrong with how a command ended."""
    if "Traceback" in text:
        return [f"a traceback: {text[-400:]!r}"]
    lines = [line for line in text.splitlines() if line.startswith(("switchmt-snn: ", _NEEDLESS))]
    if code == 0 and not lines and _unneeded(command, facts):
        return []
    needless = bool(lines) and lines[-1].startswith(_NEEDLESS) and command.startswith(("train", "study"))
    if code != (0 if needless else 1) or len(lines) != 1:
        return [f"exit code {code}, {lines or text[-200:]}"]
    path = Path(_DECORATED.sub(r"/\1", facts["path"]))
    # A checkpoint or a packed run is whole or absent, so its folder is named.
    named = [path, *(one for one in path.parents if (folder / "run") in one.parents)]
    if _asks(command, facts):  # what is named is the next call that needed room
        named = [folder / "run"]
    wrong = [] if any(str(one) in lines[0] for one in named) else [f"{path} is not named: {lines[0]}"]
    return wrong if cause in lines[0] else [*wrong, f"{cause!r} is not said: {lines[0]}"]


def main() -> int:
    """Play the points; the exit code is 1 if a command does not keep its promise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=[*COMMANDS, "all"])
    parser.add_argument("--fault", choices=FAULTS, action="append")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--record", type=Path, help="JSON file whose rows of the command are replaced")
    options = parser.parse_args()
    if not hasattr(ctypes.CDLL(None), "faults_begin"):
        with tempfile.TemporaryDirectory() as name:
            again = [sys.executable, "-m", "tests.crash.faults", *sys.argv[1:]]
            return subprocess.run(again, env={**os.environ, "LD_PRELOAD": str(built(Path(name)))}).returncode
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepared("train", folder / "finished", None)
        run_until(words("train", folder / "finished"), folder / "finished", None)
        for command in COMMANDS if options.command == "all" else [options.command]:
            for fault in options.fault or FAULTS:
                wrong += _play(command, fault, folder, options)
    return 1 if wrong else 0


def _play(command: str, fault: str, folder: Path, options: argparse.Namespace) -> int:
    started = time.monotonic()
    shutil.rmtree(folder / "whole", ignore_errors=True)
    prepared(command, folder / "whole", folder / "finished")
    code, facts = run_with_fault(words(command, folder / "whole"), folder / "whole", 0, fault)
    assert code == 0, (folder / "whole.log").read_text()
    expected = products(folder / "whole")
    points = range(options.first, facts["calls"] + 1, options.every)
    counts: collections.Counter[str] = collections.Counter()
    for point in points:
        seen = outcome(command, folder / "failed", folder / "finished", expected, point, fault)
        counts[seen] += 1
        if seen != "same":
            print(f"{command}, {fault}, call {point} of {facts['calls']}: {seen}", file=sys.stderr, flush=True)
    print(
        f"{command}, {fault}: {len(points)} of {facts['calls']} writing calls, {counts['same']} refused by one line "
        f"and end as uninterrupted; {time.monotonic() - started:.0f} s"
    )
    if options.record is not None:
        row = {"calls": facts["calls"], "failed_at": len(points), "kept": counts["same"]}
        record(options.record, f"{command}: {fault}", {**row, "environment": environment()})
    return len(points) - counts["same"]


if __name__ == "__main__":
    sys.exit(main())
