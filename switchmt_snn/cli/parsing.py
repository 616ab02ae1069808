"""From words of a command line to options: the positional arguments first, then flags over a default."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import tyro

from switchmt_snn.errors import ConfigError


def leading_names(argv: list[str]) -> tuple[list[str], list[str]]:
    """The positional arguments, which come first, and the rest."""
    count = next((index for index, word in enumerate(argv) if word.startswith("-")), len(argv))
    return argv[:count], argv[count:]


def leading_name(argv: list[str]) -> tuple[str | None, list[str]]:
    """The positional argument, which comes first, or None, and the rest."""
    return (argv[0], argv[1:]) if argv and not argv[0].startswith("-") else (None, argv)


def peek(argv: list[str], flag: str) -> str | None:
    """The value of a flag, before the others are parsed: it says which config they change."""
    for index, word in enumerate(argv):
        if word == flag and index + 1 < len(argv):
            return argv[index + 1]
        if word.startswith(f"{flag}="):
            return word.split("=", 1)[1]
    return None


RENAMED = {"evaluate": {"--engine": "--runtime"}, "export": {"--nir-profile": "--nir-dialect"}}
"""Older spellings of flags, by command; they still work, and the help does not list them."""


def parse(kind: Any, argv: list[str], command: str, default: Any) -> Any:
    """Options from flags; what no flag names has the default's value.

    Raises:
        ConfigError: an unknown flag or a wrong value; tyro's boxed message in one line.
    """
    argv = [_renamed(word, RENAMED.get(command, {})) for word in argv]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, default=default, args=argv, prog=f"switchmt-snn {command}")
    except SystemExit as stop:
        if stop.code == 0:
            raise
        raise ConfigError(_one_line(complaint.getvalue(), command)) from None


def _renamed(word: str, renamed: dict[str, str]) -> str:
    flag, equals, value = word.partition("=")
    return renamed.get(flag, flag) + equals + value


def _one_line(boxed: str, command: str) -> str:
    """The message in tyro's box (drawn with lines in a UTF-8 terminal, with spaces elsewhere), without its title."""
    lines = [line.strip("│ ") for line in boxed.splitlines() if line.strip() and line[0] not in "╭╰"]
    if "│" not in boxed:
        lines = lines[1:]
    text = " ".join(line for line in lines if not set(line) <= set("─-"))
    text = text.split("For full helptext")[0].split("Argument helptext")[0].strip().rstrip(".")
    return f"{text}; see switchmt-snn {command} --help"
