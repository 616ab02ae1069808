"""The limit of a control group, read from trees of files as Linux shows them."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from switchmt_snn.machine import memory
from switchmt_snn.machine.memory import group_bytes

UNLIMITED_1 = 9223372036854771712
"""What version 1 writes for no limit: the largest number of whole pages."""


def tree(root: Path, files: dict[str, object]) -> None:
    for name, content in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"{content}\n")


@pytest.mark.parametrize("path", ["/", "/docker/0123"])
def test_version_1_is_limited_by_its_root_or_by_the_host_path_that_a_container_does_not_see(
    tmp_path: Path, path: str
) -> None:
    tree(
        tmp_path,
        {
            "groups": f"5:cpuset:{path}\n4:memory:{path}\n0::{path}",
            "sys/memory/memory.limit_in_bytes": 1000,
            "sys/memory/memory.usage_in_bytes": 900,
            "sys/memory/memory.stat": "cache 500\ninactive_file 1\ntotal_inactive_file 250",
        },
    )
    assert group_bytes(tmp_path / "sys", tmp_path / "groups") == [1000 - (900 - 250)]


def test_version_1_with_a_nested_group(tmp_path: Path) -> None:
    tree(
        tmp_path,
        {
            "groups": "9:memory:/slurm/job_7",
            "sys/memory/slurm/job_7/memory.limit_in_bytes": 700,
            "sys/memory/slurm/job_7/memory.usage_in_bytes": 100,
            "sys/memory/slurm/memory.limit_in_bytes": 2000,
            "sys/memory/slurm/memory.usage_in_bytes": 1800,
            "sys/memory/memory.limit_in_bytes": UNLIMITED_1,
            "sys/memory/memory.usage_in_bytes": 5,
        },
    )
    assert min(group_bytes(tmp_path / "sys", tmp_path / "groups")) == 200


def test_version_2_takes_the_tightest_of_its_groups(tmp_path: Path) -> None:
    tree(
        tmp_path,
        {
            "groups": "0::/user.slice/run-1.scope",
            "sys/user.slice/run-1.scope/memory.max": 3000,
            "sys/user.slice/run-1.scope/memory.current": 2500,
            "sys/user.slice/run-1.scope/memory.stat": "anon 500\ninactive_file 2000",
            "sys/user.slice/memory.max": "max",
            "sys/user.slice/memory.current": 9000,
        },
    )
    assert group_bytes(tmp_path / "sys", tmp_path / "groups") == [2500]


def test_a_full_group_leaves_nothing(tmp_path: Path) -> None:
    tree(tmp_path, {"groups": "0::/", "sys/memory.max": 10, "sys/memory.current": 12})
    assert group_bytes(tmp_path / "sys", tmp_path / "groups") == [0]


def test_without_control_groups_nothing_is_limited(tmp_path: Path) -> None:
    assert group_bytes(tmp_path / "sys", tmp_path / "groups") == []


def test_the_machine_and_the_groups_limit_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "group_bytes", lambda *paths: [5 * memory.GIB**2, 12345])
    assert memory.available_bytes() == 12345
    monkeypatch.setattr(memory, "group_bytes", lambda *paths: [])
    assert 0 < memory.available_bytes() <= psutil.virtual_memory().total
