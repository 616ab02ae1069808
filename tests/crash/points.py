"""Commands that are ended at every file operation, and what the same command then makes of it.

A command runs in a fork of this process with a hook that counts its file operations (opening to write, renaming,
removing, making folders, truncating, syncing) and ends the process, as SIGKILL would, before operation k.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch._dynamo

import switchmt_snn.viewing.report.page
from switchmt_snn.cli import main
from switchmt_snn.export import export_run, profile_run
from switchmt_snn.runs import run as runs_run

IMPORTED = (switchmt_snn.viewing.report.page, export_run, profile_run, runs_run, torch._dynamo)
"""Before the forks, once; PyTorch's optimizers import torch._dynamo, which takes seconds."""
ENDED = 77
CONFIG = """
name: crash
seed: 3
total_steps: 260
threads: 1
tasks: {suite: gym, names: [CartPole-v1]}
network: {hidden_units: 8, timesteps: 2}
learning: {batch_size: 4, learning_starts_steps: 20, replay_capacity_steps: 300, learning_rate: 0.01,
  update_every_steps: 4}
evaluation: {episodes: 2, epsilon: 0.0, every_steps: 120, max_episode_steps: 60}
recording: {checkpoint_every_steps: 80, metrics_every_steps: 100, keep_checkpoints: 2}
"""
STUDY = """
base: config.yaml
name: crash
settings: {total_steps: 160}
vary: {learning.learning_rate: [0.01, 0.001]}
seeds: [3]
"""
"""Two trials; they train in processes of their own, which save and end when the study is ended."""
BY_RETURNS = ("--evaluation.every-steps", "None", "--total-steps", "800")
"""Longer, so that the task has the episodes by which weights are judged."""
COMMANDS: dict[str, tuple[str, ...]] = {
    "train": ("train", "CONFIG", "--run", "RUN"),
    "train, best by returns": ("train", "CONFIG", "--run", "RUN", *BY_RETURNS),
    "evaluate": ("evaluate", "RUN", "--episodes", "3"),
    "export": ("export", "RUN", "--parity-decisions", "8"),
    "profile": ("profile", "RUN", "--decisions", "8"),
    "play": ("play", "RUN", "--seconds", "0.5", "--fps", "10", "--out", "RUN/films/played.gif"),
    "report": ("report", "RUN", "--figures"),
    "pack": ("pack", "RUN", "--out", "RUN/packed"),
    "study": ("study", "STUDY", "--folder", "RUN", "--jobs", "1"),
}
_EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.symlink"}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_VARIES = re.compile(
    r"wall_s|seconds|created|peak_|steps_per_s|_bytes|^sizes$|duration|speed|^bytes$|^clock$|^environment$|^headline$|^calls$|^figures$"
)


def words(command: str, folder: Path) -> list[str]:
    """A command's words, for a run in a folder."""
    places = {"CONFIG": "config.yaml", "STUDY": "study.yaml", "RUN": "run"}
    return [
        re.sub(r"^(CONFIG|STUDY|RUN)\b", lambda at: str(folder / places[at[0]]), word) for word in COMMANDS[command]
    ]


def run_until(argv: list[str], folder: Path, point: int | None) -> tuple[int, int]:
    """Run a command in a fork, to its end or to a file operation below ``folder``.

    Returns:
        Its exit code (``ENDED`` if it was ended), and the file operations that it had begun.
    """
    code, operations = run_forked(argv, folder, lambda writing: _count_operations(str(folder), point, writing))
    return code, int(operations or 0)


def run_forked(argv: list[str], folder: Path, begin: Callable[[int], Callable[[], str]]) -> tuple[int, str]:
    """Run a command in a fork; what it says goes to the end of ``folder``'s .log file, beside it.

    Args:
        argv: its words.
        folder: where it works.
        begin: called in the fork with a pipe; what the function says that it returns goes through the pipe at the end.

    Returns:
        Its exit code, and what came through the pipe.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            ending = begin(writing)
            log = os.open(folder.parent / f"{folder.name}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(log, 1)
            os.dup2(log, 2)
            sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
            try:
                main(argv)
            except SystemExit as ended:
                code = int(ended.code or 0)
            sys.stdout.flush()
            sys.stderr.flush()
            os.write(writing, ending().encode())
            os._exit(code)
        except BaseException:
            import traceback

            traceback.print_exc()
            sys.stderr.flush()
            os._exit(70)
    os.close(writing)
    with os.fdopen(reading) as stream:
        said = stream.read()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), said


def _count_operations(folder: str, point: int | None, writing: int) -> Callable[[], str]:
    seen = [0]

    def step() -> None:
        seen[0] += 1
        if seen[0] == point:
            os.write(writing, str(seen[0]).encode())
            os._exit(ENDED)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event not in _EVENTS or (event == "open" and not (arguments[2] or 0) & _WRITES):
            return
        place = arguments[0]
        if (
            isinstance(place, int)
            or str(os.fspath(place)).startswith(f"{folder}{os.sep}")
            or not os.path.isabs(os.fspath(place))
        ):
            step()

    sync = os.fsync

    def synced(descriptor: int) -> None:
        step()
        sync(descriptor)

    sys.addaudithook(hook)
    os.fsync = synced
    return lambda: str(seen[0])


def prepared(command: str, folder: Path, finished: Path | None) -> None:
    """A folder in which a command can begin."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(CONFIG)
    (folder / "study.yaml").write_text(STUDY)
    if finished is not None and not command.startswith(("train", "study")):
        shutil.copytree(finished / "run", folder / "run")


def products(folder: Path) -> dict[str, Any]:
    """What a command leaves, without times: files by path. Nothing is left of one that was ended before."""
    found = {}
    for path in sorted((folder / "run").rglob("*")):
        name = str(path.relative_to(folder / "run"))
        if (
            path.is_file()
            and not name.endswith((".lock", ".log", ".html", ".svg", ".png"))
            and "environment" not in name
            and name != "attempts.jsonl"  # a study's processes, of which a crash ends one
        ):
            found[name] = _content(path, folder)
    return found


def _content(path: Path, folder: Path) -> Any:
    if path.suffix == ".json":
        facts = json.loads(path.read_text().replace(str(folder), "FOLDER"))
        if path.name == "manifest.json":
            facts = {key: facts.get(key) for key in ("step", "score", "judged_by")}
        return _timeless(facts)
    if path.suffix == ".jsonl":
        return [_timeless(json.loads(line)) for line in path.read_text().splitlines()]
    if path.suffix == ".csv":
        rows = csv.DictReader(io.StringIO(path.read_text()))
        return [_timeless(row) for row in rows]
    if path.suffix == ".md":
        return [line for line in path.read_text().splitlines() if "SHA" not in line and "parity.json" not in line]
    return path.read_bytes()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(item) for key, item in value.items() if key is None or not _VARIES.search(key)}
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def differing(expected: dict[str, Any], seen: dict[str, Any]) -> list[str]:
    """Files that one has and the other has not, or that are not equal."""
    return sorted(name for name in expected.keys() | seen.keys() if expected.get(name) != seen.get(name))


def outcome(command: str, folder: Path, finished: Path | None, expected: dict[str, Any], point: int) -> str:
    """End a command at a point, run it again, and compare; ``same``, or what is wrong."""
    prepared(command, folder, finished)
    code, _ = run_until(words(command, folder), folder, point)
    if code != ENDED:
        return f"it was not ended (exit code {code})"
    code, _ = run_until(words(command, folder), folder, None)
    if code != 0:
        return f"the same command again ends with exit code {code}"
    different = differing(expected, products(folder))
    return f"other content: {', '.join(different)}" if different else "same"
