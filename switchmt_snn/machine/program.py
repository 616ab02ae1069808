"""How the user called this program, so that a printed command works when it is copied."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from pathlib import Path

NAME = "switchmt-snn"
_COMMAND = re.compile(
    rf"(?<![\w/.-]){NAME} "
    r"(?=(?:train|evaluate|play|export|profile|report|compare|study|replay-policies|runs|pack|describe|doctor|check-env)\b)"
)


def program() -> str:
    """What a command begins with here: ``switchmt-snn`` if the PATH has this one, else its path, or ``python -m``."""
    called = Path(sys.argv[0])
    if is_module(called):
        return f"{_found(Path(sys.executable))} -m switchmt_snn"
    return _found(called) if called.name == NAME else NAME


def is_module(called: Path) -> bool:
    """Whether a program is this package, called as ``python -m switchmt_snn``."""
    return called.parts[-2:] == ("switchmt_snn", "__main__.py")


def runnable(text: str) -> str:
    """A text whose commands begin as the user called the program."""
    return _COMMAND.sub(lambda _: f"{program()} ", text)


def _found(called: Path) -> str:
    """The name alone, if the PATH leads to this very file; its folder's links are followed, its own are not.

    A virtual environment's ``python`` is a link to the one that it was made from, which has other packages.
    """
    on_path = shutil.which(called.name)
    same = on_path is not None and _place(Path(on_path)) == _place(called)
    return called.name if same else shlex.quote(str(called))


def _place(file: Path) -> Path:
    return file.parent.resolve() / file.name
