"""Files that are whole or absent (written under a temporary name, synced, then renamed), their names, and JSON."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from switchmt_snn.errors import WriteError
from switchmt_snn.machine.temporary import temporary_beside

_PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
_LONGEST_LIST = 120
MOST_LEVELS = 100
"""Lists and objects in each other that a JSON file may have; the deepest that we write has some twelve."""
_TOO_DEEP = f"more than {MOST_LEVELS} levels"
_NOT_TASKS = frozenset({"parity", "evaluation_onnx", "evaluation_nir"})
"""Names of our own JSON files in a run's ``export`` folder, where each task has a JSON file, too."""


def file_name(*tasks: str) -> str:
    """Part of a file's name for some tasks: the same for the same tasks, another for others, and short.

    A plain name stays as it is. Another one (``ALE/Pong-v5``, ``my_module:MyEnv-v0``) keeps its plain characters and
    gets ``~`` and 16 digits of its SHA-256; ``~`` and ``+``, which joins several tasks, are in no plain name.

    Examples:
        >>> file_name("breakout", "pong")
        'breakout+pong'
        >>> file_name("my_module:MyEnv-v0")
        'my_module_MyEnv-v0~8e46a734f0f6d4fa'
    """
    joined = "+".join(map(_one_name, tasks))
    return joined if len(joined) <= _LONGEST_LIST else _marked(joined, repr(tasks))


def _one_name(task: str) -> str:
    return task if _PLAIN_NAME.fullmatch(task) and task not in _NOT_TASKS else _marked(task, task)


def _marked(text: str, hashed: str) -> str:
    return f"{re.sub(r'[^A-Za-z0-9_.-]', '_', text)[:40].lstrip('.-')}~{sha256(hashed.encode())[:16]}"


def json_text(value: Any, indent: int | None = None) -> str:
    """Plain values as JSON (RFC 8259). It has no NaN and no infinity: a number that is not finite becomes null.

    Examples:
        >>> json_text({"q": [1.5, float("nan")]})
        '{"q": [1.5, null]}'
    """
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _require_shallow(value: Any) -> None:
    level, levels = [value], 0
    while level := [one for one in level if isinstance(one, (dict, list))]:
        levels += 1
        if levels > MOST_LEVELS:
            raise ValueError(_TOO_DEEP)
        level = [inner for one in level for inner in (one.values() if isinstance(one, dict) else one)]


def parsed_json(content: bytes | str) -> Any:
    """The value of JSON in UTF-8. ``json.loads`` also takes halves of characters, which no page can hold.

    Raises:
        ValueError: it is no JSON, no UTF-8, has a text with half of a character, or more than ``MOST_LEVELS`` levels
            (where Python itself gives up depends on how deep its caller is).

    Examples:
        >>> parsed_json("[" * 101 + "]" * 101)
        Traceback (most recent call last):
        ...
        ValueError: more than 100 levels
    """
    text = content if isinstance(content, str) else content.decode()
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error
    if text.count("[") + text.count("{") > MOST_LEVELS:
        _require_shallow(value)
    if "\\u" in text:
        json.dumps(value, ensure_ascii=False).encode()
    return value


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def writing(path: Path, option: str | None = None, whole: bool = False) -> Iterator[None]:
    """Around code that writes a file or folder: what the system refuses becomes one line that names ``path``.

    Args:
        path: what is written, by the name that it has in the end.
        option: by which a user names another place.
        whole: it is a folder that gets its name when it is whole; errors about files in it name the folder, too.

    Raises:
        WriteError: the system refused.
    """
    try:
        yield
    except OSError as error:
        raise WriteError(path, error, option) from error
    except WriteError as error:
        if not whole or not isinstance(error.__cause__, OSError):
            raise
        raise WriteError(path, error.__cause__, option) from error.__cause__


def made(folder: Path, option: str | None = None) -> Path:
    """A folder, made with those above it if it is not there.

    Raises:
        WriteError: it cannot be.
    """
    with writing(folder, option):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


@contextmanager
def written_whole(path: Path, option: str | None = None) -> Iterator[Path]:
    """A temporary path beside ``path`` for code that writes a file itself; at the end it takes the file's place.

    Each call has another one, because other processes and threads may write the same file. If the code fails, nothing
    stays of it; what stays of a process that is killed, the next one removes (``temporary_beside``).

    Raises:
        WriteError: the system refused.
    """
    temporary = temporary_beside(path)
    with writing(path, option):
        try:
            yield temporary
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def write_atomically(path: Path, content: bytes, option: str | None = None) -> None:
    """Write a file so that a crash at any moment leaves the old content or the new one.

    Raises:
        WriteError: the system refused.
    """
    with written_whole(path, option) as temporary, temporary.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make renames within a folder durable."""
    with writing(folder):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def sha256(content: bytes) -> str:
    """SHA-256 as hex text."""
    return hashlib.sha256(content).hexdigest()
