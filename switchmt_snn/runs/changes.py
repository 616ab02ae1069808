"""What is not as it was when a run last went on: the user's code, and the conditions on which sums depend.

``code_changes.jsonl`` has an object per resume at which something was another: ``step``, ``created``, ``files_sha256``
and ``conditions`` with the new values of those that differ.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from switchmt_snn.errors import RunFolderError, reason_of
from switchmt_snn.runs.files import json_text, parsed_json, write_atomically
from switchmt_snn.runs.folder import read_environment

CONDITIONS = ("python", "processor", "torch_threads", "device", "device_name")
"""What of environment.json, with the versions, decides how sums are rounded; a resume is bitwise if all are equal."""


def conditions(environment: dict[str, Any]) -> dict[str, Any]:
    """The conditions in the content of an environment.json, by name; a version as ``versions.torch``."""
    versions = {f"versions.{name}": version for name, version in environment.get("versions", {}).items()}
    return {**{key: environment[key] for key in CONDITIONS if key in environment}, **versions}


def note_changes(folder: Path, environment: dict[str, Any], step: int) -> list[str]:
    """What changed since the run last went on, as warnings; the new values are added to ``code_changes.jsonl``.

    Args:
        folder: the run folder.
        environment: of today, as ``describe_environment`` gives it. What the run does not know yet is recorded without
            being named.
        step: at which the run goes on.

    Raises:
        RunFolderError: the file of changes cannot be read.
    """
    path = folder / "code_changes.jsonl"
    now = {"files_sha256": environment["files_sha256"], "conditions": conditions(environment)}
    try:
        begun = read_environment(folder)
        known = {"files_sha256": dict(begun.get("files_sha256", {})), "conditions": conditions(begun)}
        rows = [parsed_json(line) for line in path.read_text("utf-8").splitlines()] if path.exists() else []
        for row in rows:
            for kind, values in known.items():
                values |= row.get(kind, {})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise RunFolderError(
            f"{path} cannot be read ({reason_of(error):.80}), expected JSON lines; delete it"
        ) from error
    new = {kind: _differing(known[kind], values) for kind, values in now.items()}
    if any(new.values()):
        rows.append({"step": step, "created": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **new})
        write_atomically(path, "".join(json_text(row) + "\n" for row in rows).encode())
    files = [name for name in new["files_sha256"] if name in known["files_sha256"]]
    changed = {
        name: (known["conditions"][name], value)
        for name, value in new["conditions"].items()
        if name in known["conditions"]
    }
    return [*_about_files(files, step), *_about_conditions(changed)]


def _differing(known: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in now.items() if name not in known or known[name] != value}


def _about_files(files: list[str], step: int) -> list[str]:
    if not files:
        return []
    return [
        f"warning: the code of {', '.join(files)} changed since the run last went on; it continues from step {step:,} "
        "with the new code, so its numbers before and after may not belong together (code_changes.jsonl)"
    ]


def _about_conditions(changed: dict[str, tuple[Any, Any]]) -> list[str]:
    if not changed:
        return []
    shown = ", ".join(f"{name.removeprefix('versions.')} ({old} -> {new})" for name, (old, new) in changed.items())
    return [
        f"warning: {shown} changed since the run last went on; it continues, but not bitwise as it would have without "
        "the change (code_changes.jsonl)"
    ]
