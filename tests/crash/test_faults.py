"""On a disk that is full or broken a command says so in one line and loses nothing: a sample of its writing calls.

``python -m tests.crash.faults all`` takes every call.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.crash.faults import SOURCE, built

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux" or shutil.which("cc") is None, reason="a library is preloaded"),
]
SAMPLES = {"train": ("60", "17"), "evaluate": ("9", "4"), "export": ("31", "11"), "play": ("13", "6")}
"""Every so many calls, from which one on."""


@pytest.mark.parametrize("command", SAMPLES)
def test_a_full_or_broken_disk_is_one_line_and_loses_nothing(command: str) -> None:
    every, first = SAMPLES[command]
    words = [sys.executable, "-m", "tests.crash.faults", command, "--every", every, "--first", first]
    result = subprocess.run(words, cwd=SOURCE.parents[2], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert f"{command}, full: " in result.stdout
    assert f"{command}, broken: " in result.stdout


def test_the_library_fails_the_call_that_it_is_told_and_later_ones_that_need_room(tmp_path: Path) -> None:
    """So that the other test can fail."""
    code = f"""
import ctypes, os
library = ctypes.CDLL(None)
library.faults_begin(b"{tmp_path}/a/", ctypes.c_long(3), 28, 1)
seen = []
for path in ("a/one", "b", "a/two", "a/three"):
    try:
        with open(f"{tmp_path}/" + path, "w") as stream:
            stream.write("x")
        seen.append(path)
    except OSError as error:
        seen.append(error.errno)
os.rename("{tmp_path}/a/one", "{tmp_path}/a/four")
print(seen, library.faults_calls(), os.listdir("{tmp_path}/a"))
"""
    (tmp_path / "a").mkdir()
    library = built(tmp_path)
    words = [sys.executable, "-c", code]
    seen = subprocess.run(words, env={"LD_PRELOAD": str(library)}, capture_output=True, text=True, check=True)
    assert seen.stdout == "['a/one', 'b', 28, 28] 5 ['four']\n"
