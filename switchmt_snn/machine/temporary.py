"""Temporary files and folders beside what they become. What a killed process left is removed by the next one.

A name says whose it is: machine, process, and which of the processes that had this number. So nothing is removed that
a process still writes, and nothing of another machine, another user, or another program.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_NAME = re.compile(r"\..+\.([0-9a-f]{6})-(\d{1,10})-([0-9a-f]{6})-[0-9a-f]{6}\.tmp", re.DOTALL)
_LIFE = secrets.token_hex(3)
"""Of this process: in a container, every process of a command may have the same number."""
_cleared: set[tuple[int, Path]] = set()
"""Folders that a process looked through."""


def temporary_beside(path: Path) -> Path:
    """A new name in the folder of ``path``, for a file or folder that will take its place.

    The first call for a folder removes what processes left that were killed.
    """
    asked = (os.getpid(), path.parent)
    if asked not in _cleared:
        _cleared.add(asked)
        _clear(path.parent)
    return path.with_name(f".{path.name}.{_machine()}-{os.getpid()}-{_LIFE}-{secrets.token_hex(3)}.tmp")


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """A new folder that will take the place of ``path``; removed at the end, if it was not renamed."""
    folder = temporary_beside(path)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _clear(folder: Path) -> None:
    """Remove temporary files of this user's and this machine's processes that are gone."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            named = _NAME.fullmatch(entry.name)
            if named is None or named[1] != _machine() or not _is_gone(int(named[2]), named[3]):
                continue
            with suppress(OSError):
                if entry.stat(follow_symlinks=False).st_uid != os.geteuid():
                    continue
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    os.unlink(entry.path)


def _is_gone(process: int, life: str) -> bool:
    if process == os.getpid():
        return life != _LIFE
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # somebody else's
        return False
    return False


@functools.cache
def _machine() -> str:
    """What tells machines, and containers with processes of their own, apart."""
    facts = [platform.node()]
    with suppress(OSError):
        facts.append(os.readlink("/proc/self/ns/pid"))
    with suppress(OSError, ValueError):
        facts.append(Path("/etc/machine-id").read_text("ascii"))
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()[:6]
