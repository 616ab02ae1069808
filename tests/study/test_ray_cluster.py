"""The engine ``ray`` on a cluster of two nodes that the test starts, with token authentication."""

from __future__ import annotations

import csv
import json
import os
import secrets
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.study.test_running import ROOT, begin, ended, eventually, study_command, tiny, trained

pytest.importorskip("ray", reason="needs the extra ray")
pytestmark = pytest.mark.slow


class Nodes:
    """The cluster's process and its environment."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.environment = environment
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.study.ray_nodes"],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip()
        assert ":" in self.address

    def lose_the_second(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write("lose\n")
        self.process.stdin.flush()
        assert self.process.stdout.readline().strip() == "lost"


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Nodes]:
    for name, value in {
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(16),
        "RAY_USAGE_STATS_ENABLED": "0",
        "PYTHONPATH": str(ROOT),
    }.items():
        monkeypatch.setenv(name, value)
    cluster = Nodes(dict(os.environ))
    yield cluster
    cluster.process.communicate(timeout=120)


def nodes_of(folder: Path) -> dict[str, list[str]]:
    """The nodes on which each trial was begun."""
    logs = (folder / "logs").glob("*.log")
    return {
        log.stem: [line.split()[1] for line in log.read_text().splitlines() if line.startswith("node ")] for log in logs
    }


def weights(run: Path) -> dict[str, Any]:
    """Sums of everything in the last checkpoint."""
    last = max((run / "checkpoints").glob("step-*"))
    manifest = json.loads((last / "manifest.json").read_text())
    return {"files": manifest["files"], "segments": manifest["segments"]}


def test_run_folders_are_those_of_the_local_engine_also_when_a_node_is_lost(nodes: Nodes, tmp_path: Path) -> None:
    path = tiny(tmp_path / "s.yaml", "seeds: 3\n", steps=3000)
    process = begin(path, "--folder", "ray", "--engine", "ray", "--address", nodes.address, cwd=tmp_path)
    first = [tmp_path / "ray" / "trials" / f"s_seed{seed}" for seed in (1, 2)]
    eventually(lambda: all(list((run / "checkpoints").glob("step-*")) for run in first) or process.poll() is not None)
    assert process.poll() is None, process.communicate()[0]
    begun = nodes_of(tmp_path / "ray")
    assert len({begun["s_seed1"][0], begun["s_seed2"][0]}) == 2, "one trial on each node"
    nodes.lose_the_second()
    code, out = ended(process)
    assert code == 0, out
    assert "3 trials (1 variants), 0 finished, 2 at a time" in out
    rows = [json.loads(line) for line in (tmp_path / "ray" / "attempts.jsonl").read_text().splitlines()]
    assert sorted(row["code"] for row in rows) == [-9, 0, 0, 0], "the trial of the lost node was tried again"
    again = next(row["trial"] for row in rows if row["code"] == -9)
    assert f"trying {again} again" in out
    assert len(nodes_of(tmp_path / "ray")[again]) == 2
    code, out = ended(begin(path, "--folder", "local", "--jobs", "1", cwd=tmp_path))
    assert code == 0, out
    for seed in (1, 2, 3):
        one, other = (tmp_path / engine / "trials" / f"s_seed{seed}" for engine in ("ray", "local"))
        assert trained(one) == trained(other)
        assert weights(one) == weights(other)
    for name in ("tables.md", "scores.csv"):
        assert (tmp_path / "ray" / name).read_bytes() == (tmp_path / "local" / name).read_bytes()


def test_a_stop_saves_and_a_wrong_token_or_address_is_one_line(nodes: Nodes, tmp_path: Path) -> None:
    path = tiny(tmp_path / "s.yaml", "seeds: 2\n", steps=1_000_000)
    process = begin(path, "--folder", "s", "--engine", "ray", "--address", nodes.address, cwd=tmp_path)
    runs = [tmp_path / "s" / "trials" / f"s_seed{seed}" for seed in (1, 2)]
    eventually(lambda: all(list((run / "checkpoints").glob("step-*")) for run in runs) or process.poll() is not None)
    assert process.poll() is None, process.communicate()[0]
    process.terminate()
    code, out = ended(process)
    assert code == 130, out
    assert "continue exactly here" in out
    for run in runs:
        rows = list(csv.DictReader((run / "episodes.csv").read_text().splitlines()))
        steps = max(int(one.name[5:]) for one in (run / "checkpoints").glob("step-*"))
        assert steps >= int(rows[-1]["step"]), "saved where it stood"
    for address, environment, words in (
        (
            nodes.address,
            {"RAY_AUTH_TOKEN": secrets.token_hex(16)},
            "no Ray cluster answers (it does not take this token)",
        ),
        ("127.0.0.1:9", {}, "nothing answers there"),
        ("127.0.0.1", {}, "expected HOST:PORT"),
    ):
        failed = subprocess.run(
            study_command(path, "--folder", "t", "--engine", "ray", "--address", address),
            cwd=tmp_path,
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
        )
        assert failed.returncode == 2, failed.stderr
        assert words in failed.stderr
        assert failed.stderr.count("\n") == 1, failed.stderr
        assert not (tmp_path / "t" / "trials").exists()
