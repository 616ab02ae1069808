"""Pages that say where something is are right: the files exist and define the names."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PACKAGES = re.findall(r"^\| `(\w+)(?:/|\.py)` \|", PAGE, re.MULTILINE)
PLACES = re.findall(r"^\| [^|]+ \| (`[^|]+) \| ([^|]+) \|$", PAGE, re.MULTILINE)


def in_package(path: str) -> Path:
    """A path as the page writes it: relative to the package, or to the repository for ``export/``."""
    return ROOT / path if path.startswith("export/") else ROOT / "switchmt_snn" / path


def test_the_page_lists_every_package() -> None:
    folders = {path.parent.name for path in (ROOT / "switchmt_snn").glob("*/__init__.py")}
    assert set(PACKAGES) == (folders | {"errors"}) - {"configs"}


def test_the_page_fits_on_one_screen() -> None:
    assert PAGE.count("\n") <= 80


@pytest.mark.parametrize(("files", "names"), PLACES)
def test_a_file_defines_the_names_that_the_page_gives(files: str, names: str) -> None:
    paths = [in_package(path) for path in re.findall(r"`([^`]+)`", files)]
    assert paths, files
    assert all(path.exists() for path in paths), files
    text = paths[0].read_text(encoding="utf-8")
    found = re.findall(r"`([^`]+)`", names)
    assert found, f"{files} defines no name that the page gives"
    for name in found:
        for part in name.split("."):
            assert re.search(rf"(?:def|class|void) {part}\b", text), f"{files} does not define {name}"


def test_there_is_a_place_for_each_thing_that_readers_look_for() -> None:
    assert len(PLACES) >= 9
