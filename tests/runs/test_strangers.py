"""Checkpoints whose checksums were made to fit: what is refused before it is used."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
import zstandard

from switchmt_snn.config import load_config, resolve
from switchmt_snn.errors import CheckpointError
from switchmt_snn.learning.parts import make_replay
from switchmt_snn.runs.checkpoint import CheckpointStore
from switchmt_snn.runs.files import sha256
from switchmt_snn.runs.manifest import seal
from switchmt_snn.tasks.registry import make_suite

RUN = Path(__file__).parents[1] / "fixtures" / "runs" / "gym"


def changed(folder: Path, content: bytes | None, **entry: Any) -> CheckpointStore:
    """A copy of a stored run's checkpoints whose first segment has another content or another place."""
    checkpoints = folder / "checkpoints"
    shutil.copytree(RUN / "checkpoints", checkpoints)
    path = checkpoints / "step-000000000400" / "manifest.json"
    manifest = json.loads(path.read_bytes())
    del manifest["seal"]
    manifest["segments"][0].update(entry)
    if content is not None:
        manifest["segments"][0]["sha256"] = sha256(content)
        (checkpoints / "replay" / f"{sha256(content)}.zst").write_bytes(content)
    path.write_text(json.dumps({**manifest, "seal": seal(manifest)}))
    return CheckpointStore(checkpoints)


@pytest.mark.parametrize(
    ("content", "entry", "reason"),
    [
        (
            zstandard.compress(bytes(2**26)),
            {},
            "declares 67,108,864 bytes, expected 2,568",
        ),
        (zstandard.compress(bytes(7)), {}, "declares 7 bytes"),
        (b"no frame", {}, "is not Zstandard"),
        (None, {"task": 9}, "its 4 replay segments are not the 4 that its state refers to"),
        (None, {"lane": 99}, "its 4 replay segments are not the 4"),
    ],
)
def test_segments_are_refused_before_a_replay_changes(
    content: bytes | None, entry: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    config = resolve(load_config(RUN / "config.yaml"))
    suite = make_suite(config.tasks)
    replays = [make_replay(config, suite, torch.device("cpu")) for _ in suite.names]
    with pytest.raises(CheckpointError, match=reason):
        changed(tmp_path, content, **entry).load(replays)
    assert all(len(replay) == 0 and replay.transitions_added == 0 for replay in replays)
