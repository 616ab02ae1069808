"""The streams that texts and tables go to: any encoding, any width."""

from __future__ import annotations

import codecs
import os
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

FILE_COLUMNS = 200
"""Width of tables in a file or a pipe, which have none of their own."""

_SPELLED = {"µ": "u", "μ": "u", "±": "+-", "×": "x", "…": "...", "–": "-", "—": "-", "→": "->", "≥": ">=", "≤": "<="}


def speak_any_encoding() -> None:
    """Characters that stdout or stderr cannot hold are spelled out in place of ending the program.

    Streams that are not text files of the system (a test's, a notebook's) stay as they are.
    """
    codecs.register_error("spelled", _spelled)
    for stream in (sys.stdout, sys.stderr):
        reconfigure: Any = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="spelled")


def _spelled(error: UnicodeError) -> tuple[str, int]:
    """Error handler of encoders: ``µ`` as ``u``, lines of boxes as ``-``, others as their escapes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    return "".join(map(_ascii, text)), error.end


def _ascii(character: str) -> str:
    if "\u2500" <= character <= "\u257f":  # box drawing
        return "-"
    return _SPELLED.get(character) or character.encode("ascii", "backslashreplace").decode()


def console(stderr: bool = False) -> Console:
    """Where a command prints: as wide as the terminal, or wide enough for most tables if there is none."""
    from rich.console import Console  # a tenth of the time that --help takes

    made = Console(stderr=stderr, markup=False)  # names may hold brackets
    if not made.is_terminal and "COLUMNS" not in os.environ:
        made.width = FILE_COLUMNS
    return made
