"""After a crash at a file operation, the same command ends as one that was not interrupted: a sample of the points.

``python -m tests.crash.run all`` takes every point.
"""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest

from tests.crash.points import COMMANDS, ENDED, outcome, prepared, products, run_until, words

pytestmark = pytest.mark.slow  # a run is trained several times


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("crash") / "finished"
    prepared("train", folder, None)
    assert run_until(words("train", folder), folder, None)[0] == 0
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_the_same_command_goes_on_after_a_crash(command: str, finished: Path, tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    prepared(command, whole, finished)
    code, operations = run_until(words(command, whole), whole, None)
    assert (code, operations > 3) == (0, True)
    expected = products(whole)
    assert len(expected) > 5
    for point in random.Random(operations).sample(range(1, operations + 1), 2):
        seen = outcome(command, tmp_path / "crashed", finished, expected, point)
        assert seen == "same", (command, point, operations, seen)


def test_a_run_that_was_killed_before_its_page_was_written_gets_it(finished: Path, tmp_path: Path) -> None:
    expected = products(finished)
    prepared("report", tmp_path / "again", finished)
    for name in ("report.json", "report.html"):
        (tmp_path / "again" / "run" / name).unlink()
    assert run_until(words("train", tmp_path / "again"), tmp_path / "again", None)[0] == 0
    assert products(tmp_path / "again") == expected
    assert (tmp_path / "again" / "run" / "report.html").is_file()


def test_what_a_killed_run_left_half_removed_is_removed_by_the_next_command(finished: Path, tmp_path: Path) -> None:
    """Also after the last checkpoint, which no other one follows."""
    expected = products(finished)
    prepared("report", tmp_path / "again", finished)
    checkpoints = tmp_path / "again" / "run" / "checkpoints"
    shutil.copytree(checkpoints / "step-000000000240", checkpoints / "step-000000000080")
    (checkpoints / "step-000000000080" / "manifest.json").unlink()
    (checkpoints / "replay" / f"{'0' * 64}.zst").write_bytes(b"of no checkpoint")
    assert run_until(words("train", tmp_path / "again"), tmp_path / "again", None)[0] == 0
    assert products(tmp_path / "again") == expected


def test_a_crash_ends_the_command_and_leaves_its_files(tmp_path: Path) -> None:
    """The hook ends where it says, so that the other test can fail."""
    folder = tmp_path / "run"
    prepared("train", folder, None)
    code, operations = run_until(words("train", folder), folder, 30)
    assert (code, operations) == (ENDED, 30)
    assert (folder / "run" / "environment.json").is_file()
    assert not list((folder / "run" / "evaluations").glob("*"))
