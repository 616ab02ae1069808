"""Which modules named by stored files may be imported: those of runs that this user made, named, or trusts.

A run folder can come from anybody, and importing a module runs its code. So a run that names modules keeps an HMAC over
their names, made with a key of the user who trained it. Modules of a stored config without it are refused, until the
user names them or says ``--trust``. Everything else that is imported, the user's own program or config names.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import re
import secrets
import stat
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from switchmt_snn.errors import UntrustedError, printable

SIGNATURE = "modules_hmac"
"""The key of ``environment.json`` and of a study's ``trials.json`` that holds the HMAC."""
_KEY_BYTES = 32
_OURS = __name__.partition(".")[0]
_NAMED = re.compile(r"([^\W\d]\w*(?:\.[^\W\d]\w*)*):")


@dataclass
class Known:
    """What this process has read and was told.

    Attributes:
        refused: modules of stored files, each with the line that refuses them.
        allowed: modules that the user made a run of, named, or trusts.
        everything: whether ``--trust`` was given.
    """

    refused: dict[str, str] = field(default_factory=dict)
    allowed: set[str] = field(default_factory=set)
    everything: bool = False


known = Known()


def modules_in(settings: object) -> tuple[str, ...]:
    """Modules outside this package that any setting names, as ``module:Name`` or ``module:EnvId``, sorted.

    Args:
        settings: nested dicts and lists of plain values.

    Examples:
        >>> modules_in({"tasks": {"names": ["CartPole-v1", "my_tasks:Maze-v0"]}, "network": {"neuron": "IF"}})
        ('my_tasks',)
    """
    found: set[str] = set()
    left = [settings]
    while left:
        value = left.pop()
        if isinstance(value, dict):
            left += value.values()
        elif isinstance(value, (list, tuple)):
            left += value
        elif isinstance(value, str) and (named := _NAMED.match(value)) is not None:
            found.add(named[1])
    return tuple(sorted(module for module in found if module.partition(".")[0] != _OURS))


def note_stored(modules: Iterable[str], place: Path, signature: object) -> None:
    """Say that a stored file names modules: without a signature of this user's their import is refused.

    Args:
        modules: from ``modules_in``.
        place: the folder of the run or study, for the error.
        signature: what is stored with them.
    """
    modules = tuple(modules)
    if is_signed(modules, signature):
        known.allowed.update(modules)
        return
    names, several = ", ".join(modules), "s" * (len(modules) > 1)
    line = (
        f"{printable(place)} names the module{several} {names}, whose code would run, expected a run that you made "
        f"yourself{_why_not_known()}; if you know {'them' if several else 'it'}, add --trust (in Python: trust=True)"
    )
    known.refused |= dict.fromkeys(modules, line)


def allow(modules: Iterable[str]) -> None:
    """Let modules be imported: the user names or trusts them."""
    known.allowed.update(modules)


def allow_everything() -> None:
    """Let this process import whatever stored files name (``--trust``)."""
    known.everything = True


def require_trusted(modules: Iterable[str]) -> None:
    """Refuse modules that a stored file names and this user does not trust.

    Raises:
        UntrustedError: naming the folder and its modules.
    """
    for module in modules:
        if module in known.refused and module not in known.allowed and not known.everything:
            raise UntrustedError(known.refused[module])


def signature_of(modules: Iterable[str]) -> str:
    """The HMAC of this user over the names of modules; makes the key if there is none.

    Raises:
        OSError: there is no key, and none can be made.
    """
    return _hmac(_key(make=True), modules)


def is_signed(modules: Iterable[str], signature: object) -> bool:
    """Whether a signature is this user's, over these modules."""
    if not isinstance(signature, str):
        return False
    try:
        expected = _hmac(_key(make=False), modules)
    except OSError:
        return False
    return hmac.compare_digest(signature.encode("utf-8", "replace"), expected.encode())


def stored_signature(path: Path) -> object:
    """The signature in a JSON file of ours; None if there is none, or it cannot be read."""
    try:
        facts = json.loads(path.read_bytes()) if path.is_file() else None
    except (OSError, ValueError, RecursionError):
        return None
    return facts.get(SIGNATURE) if isinstance(facts, dict) else None


def _hmac(key: bytes, modules: Iterable[str]) -> str:
    return hmac.new(key, "\n".join(["modules", *modules]).encode(), hashlib.sha256).hexdigest()


def _why_not_known() -> str:
    """Why no run can be known as this user's; nothing if the key is good, or not made yet."""
    try:
        _key(make=False)
    except FileNotFoundError:
        return ""
    except OSError as error:
        return f" (none is known as yours: {printable(error)})"
    return ""


def _key(make: bool) -> bytes:
    """The user's key.

    Raises:
        FileNotFoundError: there is none, and none is made.
        OSError: it cannot be made or read, or is not this user's alone.
    """
    path = _folder() / "trust.key"
    try:
        return _read(path)
    except FileNotFoundError:
        if not make:
            raise
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(secrets.token_bytes(_KEY_BYTES))
            stream.flush()
            os.fsync(stream.fileno())
        with suppress(FileExistsError):  # another process was first: its key counts
            os.link(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
    return _read(path)


def _folder() -> Path:
    """The user's folder for such files (XDG Base Directory Specification).

    Raises:
        OSError: the user has no home.
    """
    stated = Path(os.environ.get("XDG_STATE_HOME", ""))
    if stated.is_absolute():
        return stated / "switchmt-snn"
    try:
        return Path.home() / ".local" / "state" / "switchmt-snn"
    except RuntimeError as error:
        raise OSError(f"no home folder for a key ({error})") from error


def _read(path: Path) -> bytes:
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as stream:
        facts = os.fstat(descriptor)
        content = stream.read(_KEY_BYTES + 1) if stat.S_ISREG(facts.st_mode) else b""
    if facts.st_uid != os.geteuid() or facts.st_mode & 0o077 or len(content) != _KEY_BYTES:
        raise PermissionError(f"{path} is not a file of {_KEY_BYTES} bytes that only you can read; remove it")
    return content
