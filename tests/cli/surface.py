"""Every option of every command, with its values: ``python -m tests.cli.surface`` writes surface.txt anew."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any, NoReturn
from unittest import mock

import tyro
from tyro.constructors import ConstructorRegistry

from switchmt_snn.cli import main
from switchmt_snn.cli.entry import COMMANDS

SURFACE = Path(__file__).with_name("surface.txt")


def options(command: str) -> list[str]:
    """The options of a command with their values, in the order of its help, from the parser that tyro makes."""
    found: list[str] = []

    def listed(kind: Any, default: Any, registry: ConstructorRegistry, **_: Any) -> NoReturn:
        for action in tyro.extras.get_parser(kind, default=default, registry=registry)._actions:
            values = action.metavar or "/".join(map(str, action.choices or ()))
            found.append(" ".join([*action.option_strings, str(values)]).strip())
        raise SystemExit(0)

    with mock.patch.object(tyro, "cli", listed), contextlib.suppress(SystemExit):
        main([command])
    return found


def surface() -> str:
    """All commands and their options, one a line."""
    return "\n".join(f"{command} {option}" for command in COMMANDS for option in options(command)) + "\n"


if __name__ == "__main__":
    SURFACE.write_text(surface())
