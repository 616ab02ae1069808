"""How a printed command begins: as it can be pasted."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from switchmt_snn.machine.program import program


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An environment's ``python`` and ``switchmt-snn``, and another folder with links to both."""
    own, other = tmp_path / "own", tmp_path / "other"
    for folder in (own, other):
        folder.mkdir()
    (own / "python").symlink_to(sys.executable)
    (other / "python").symlink_to(sys.executable)
    (own / "switchmt-snn").write_text("#!/bin/sh\n")
    (own / "switchmt-snn").chmod(0o755)
    (other / "switchmt-snn").symlink_to(own / "switchmt-snn")
    monkeypatch.setattr(sys, "executable", str(own / "python"))
    return tmp_path


@pytest.mark.parametrize(
    ("called", "name", "rest"),
    [("own/switchmt-snn", "switchmt-snn", ""), ("switchmt_snn/__main__.py", "python", " -m switchmt_snn")],
)
def test_the_name_alone_where_the_path_has_this_one(
    called: str, name: str, rest: str, places: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [str(places / called)])
    monkeypatch.setenv("PATH", str(places / "own"))
    assert program() == f"{name}{rest}"
    (places / "linked").symlink_to(places / "own")
    monkeypatch.setenv("PATH", str(places / "linked"))
    assert program() == f"{name}{rest}"
    for elsewhere in ("other", "nowhere"):  # a link to the same interpreter is another environment
        monkeypatch.setenv("PATH", str(places / elsewhere))
        assert program() == f"{places / 'own' / name}{rest}"
