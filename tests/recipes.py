"""The code of docs/extending.md, so that tests run what a reader copies."""

from __future__ import annotations

import re
from pathlib import Path

EXTENDING = Path(__file__).parent.parent / "docs" / "extending.md"


def code_of(section: str) -> list[str]:
    """The code blocks of a section, in order."""
    parts = re.split(r"^## (.+)$", EXTENDING.read_text(encoding="utf-8"), flags=re.MULTILINE)
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))
    return re.findall(r"^```\w+\n(.*?)^```$", sections[section], flags=re.MULTILINE | re.DOTALL)
