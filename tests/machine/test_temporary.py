"""Temporary files: what a killed process left goes, and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from switchmt_snn.machine import temporary
from switchmt_snn.runs.files import write_atomically

KILLED = """
import os, signal, sys
from pathlib import Path
from switchmt_snn.machine.temporary import temporary_beside
from switchmt_snn.runs.files import written_whole
inner = temporary_beside(Path(sys.argv[1]) / "packed")
inner.mkdir()
(inner / "weights").write_text("half")
with written_whole(Path(sys.argv[1]) / "scores.json") as half:
    half.write_text("half")
    print("writing", flush=True)
    sys.stdin.read() if sys.argv[2:] else os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(autouse=True)
def _asked_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(temporary, "_cleared", set())


def test_what_a_killed_process_left_is_removed_by_the_next_write(tmp_path: Path) -> None:
    ended = subprocess.run((sys.executable, "-c", KILLED, tmp_path), check=False)
    assert ended.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 2
    write_atomically(tmp_path / "other.json", b"{}")
    assert [path.name for path in tmp_path.iterdir()] == ["other.json"]


def test_what_a_living_process_writes_stays(tmp_path: Path) -> None:
    words = (sys.executable, "-c", KILLED, str(tmp_path), "waits")
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as living:
        assert living.stdout is not None
        living.stdout.readline()
        write_atomically(tmp_path / "other.json", b"{}")
        assert len(list(tmp_path.iterdir())) == 3
        living.communicate()
    assert (tmp_path / "scores.json").read_text() == "half"


def test_nothing_of_others_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = subprocess.Popen((sys.executable, "-c", ""))
    gone.wait()
    machine, life = temporary._machine(), "abcdef"
    kept = [
        f".a.json.{gone.pid}.tmp",  # of another program, or of an older version
        f".a.json.{'0' * 6}-{gone.pid}-{life}-000000.tmp",  # of another machine
        f".a.json.{machine}-{os.getppid()}-{life}-000000.tmp",  # of a process that lives
        f".a.json.{machine}-{os.getpid()}-{temporary._LIFE}-000000.tmp",  # of another thread
        f"a.json.{machine}-{gone.pid}-{life}-000000.tmp",
    ]
    for name in kept:
        (tmp_path / name).write_text("theirs")
    before = f".a.json.{machine}-{os.getpid()}-{life}-000000.tmp"  # an earlier process of this number
    (tmp_path / before).write_text("ours")
    (tmp_path / "elsewhere").write_text("theirs")
    (tmp_path / f".b.{machine}-{gone.pid}-{life}-000000.tmp").symlink_to(tmp_path / "elsewhere")
    (tmp_path / f".c.{machine}-{gone.pid}-{life}-000000.tmp").symlink_to(tmp_path)
    temporary.temporary_beside(tmp_path / "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*kept, "elsewhere"])

    monkeypatch.setattr(temporary, "_cleared", set())
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)  # another user's
    (tmp_path / before).write_text("theirs")
    temporary.temporary_beside(tmp_path / "new")
    assert (tmp_path / before).exists()
