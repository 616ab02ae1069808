"""A checkpoint's manifest: what a file that may come from a stranger must hold before anything in it is used.

A manifest is sealed by a checksum of its own content. That finds damage; it proves nothing of who wrote it.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from switchmt_snn.errors import CheckpointError, shown
from switchmt_snn.runs.files import parsed_json, sha256

FORMAT = 4
"""Goes up when a saved state gets another shape. 2: paused episodes of every task. 4: model.safetensors may be Q*."""
MOST_BYTES = 64 * 1024**2
"""Of a manifest or a state.json that is read."""
FILES = ("model.safetensors", "training.safetensors", "state.json")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_LARGEST = 2**62


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a checkpoint's folder, checked.

    Raises:
        CheckpointError: it cannot be read, is damaged, is of a newer format, or holds what no manifest holds.
    """
    try:
        content = (folder / "manifest.json").read_bytes()
    except OSError as error:
        raise CheckpointError("manifest.json cannot be read") from error
    manifest = read_json(content, "manifest.json")
    if not isinstance(manifest, dict) or not _whole(manifest.get("format")):
        raise CheckpointError("manifest.json is not a manifest")
    if manifest["format"] > FORMAT:
        raise CheckpointError(f"format {manifest['format']} is newer than {FORMAT}; update switchmt-snn")
    if manifest.pop("seal", None) != seal(manifest):
        raise CheckpointError("manifest.json has another checksum")
    for key, holds, expected in _FACTS:
        if key not in manifest and key not in _OPTIONAL:
            raise CheckpointError(f"manifest.json has no {key}, expected {expected}")
        if key in manifest and not holds(manifest[key]):
            raise CheckpointError(f"{key} in manifest.json is {shown(manifest[key])}, expected {expected}")
    return manifest


def seal(manifest: dict[str, Any]) -> str:
    """Checksum of a manifest's own content."""
    return sha256(json.dumps(manifest, sort_keys=True).encode())


def read_json(content: bytes, name: str) -> Any:
    """The content of a JSON file.

    Raises:
        CheckpointError: it is too large, too deep, or no JSON.
    """
    if len(content) > MOST_BYTES:
        raise CheckpointError(f"{name} has {len(content):,} bytes, expected at most {MOST_BYTES:,}")
    try:
        return parsed_json(content)
    except ValueError as error:
        raise CheckpointError(f"{name} is not JSON ({error!s:.60})") from error


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _LARGEST


def _digest(value: Any) -> bool:
    return isinstance(value, str) and _DIGEST.fullmatch(value) is not None


def _is_segment(entry: Any) -> bool:
    numbers = ("task", "lane", "number")
    return isinstance(entry, dict) and all(_whole(entry.get(key)) for key in numbers) and _digest(entry.get("sha256"))


def _are_files(files: Any) -> bool:
    known = isinstance(files, dict) and FILES[0] in files and set(files) <= set(FILES)
    return known and all(map(_digest, files.values()))


_FACTS: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("step", _whole, "a whole number of at least 0"),
    ("files", _are_files, f"SHA-256 sums of {', '.join(FILES)}"),
    (
        "segments",
        lambda entries: isinstance(entries, list) and all(map(_is_segment, entries)),
        "a list of segments with task, lane, number and sha256",
    ),
    (
        "logs",
        lambda logs: isinstance(logs, dict) and all(map(_whole, logs.values())),
        "bytes of each log",
    ),
    ("acting_network", lambda name: name in ("online", "target"), "online or target"),
    ("score", lambda score: isinstance(score, (int, float)) and abs(score) < math.inf, "a finite number"),
    ("judged_by", lambda name: name in ("evaluation", "returns"), "evaluation or returns"),
)
_OPTIONAL = ("acting_network", "score", "judged_by")
