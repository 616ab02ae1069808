"""The streams that texts and tables go to: any encoding, any width."""

from __future__ import annotations

import codecs
import contextlib
import os
import sys
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TextIO

from switchmt_snn.runs.files import json_text

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


@contextlib.contextmanager
def each_warning_once() -> Iterator[None]:
    """Within it Python's warnings are shown once each; libraries make Python forget that it has shown them."""
    seen: set[tuple[str, type[Warning]]] = set()
    show = warnings.showwarning

    def show_once(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if (str(message), category) not in seen:
            seen.add((str(message), category))
            show(message, category, filename, lineno, file, line)

    warnings.showwarning = show_once
    try:
        yield
    finally:
        warnings.showwarning = show


_for_json: list[TextIO] = []


@contextlib.contextmanager
def json_only() -> Iterator[None]:
    """Within it stdout is for ``print_json`` alone; what else is printed, as by environments, goes to stderr."""
    _for_json.append(sys.stdout)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _for_json.pop()


def print_json(value: Any, indent: int | None = None) -> None:
    """Print plain values as JSON, or a text that is JSON already, as the result of a command."""
    print(value if isinstance(value, str) else json_text(value, indent), file=_for_json[-1] if _for_json else None)


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
