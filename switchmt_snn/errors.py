"""Errors that a user can act on: every message says what was seen, what was expected and what to do.

The command line prints the message as one line and exits with ``exit_code``; a library user catches the class.
"""

from __future__ import annotations

import difflib
import errno
import math
from collections.abc import Iterable

_LARGEST_SHOWN = 8
"""Numbers of an array that an error shows one by one."""
_LONGEST_SHOWN = 160
"""Characters of a value that an error shows."""


class SwitchMTError(Exception):
    """Base of every error that this package raises on purpose.

    ``exit_code`` is 2 for wrong use (the user changes the command) and 1 for a run that failed by itself.
    """

    exit_code = 2

    def __init__(self, message: object = "") -> None:
        """Make it; whatever names are in the message, it is one line that a terminal shows as it is."""
        super().__init__(_escaped(str(message)))


class ConfigError(SwitchMTError):
    """A setting is unknown, of the wrong type, out of range, or contradicts another one."""


class UntrustedError(SwitchMTError):
    """A stored file names modules that this user neither trained with nor trusts (``--trust``, ``trust=True``)."""


class TaskError(SwitchMTError):
    """A task does not exist, cannot be made, or has a space that a Q-network cannot serve."""


class RunFolderError(SwitchMTError):
    """The run folder is missing, foreign, in use, not writable, or holds another config."""


class WriteError(RunFolderError):
    """A file or folder cannot be written.

    ``exit_code`` is 2 for a place that is wrong (another one may do), and 1 for a disk that is full or fails.

    Attributes:
        seen: what could not be written, and why; the message without what to do.
    """

    def __init__(self, path: object, error: OSError, option: str | None = None) -> None:
        """Make it.

        Args:
            path: of the file or folder.
            error: what the system said.
            option: by which a user names another place.
        """
        self.seen = f"{path} cannot be written ({error.strerror or reason_of(error)})"
        if error.errno in _WRONG_PLACE:
            remedy = "" if option is None else f"; name another with {option}"
            super().__init__(f"{self.seen}, expected a writable folder{remedy}")
        else:
            self.exit_code = 1
            super().__init__(f"{self.seen}, expected a disk that works and has room; then run the same command again")


_WRONG_PLACE = {
    *(errno.EACCES, errno.EEXIST, errno.EINVAL, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENOENT),
    *(errno.ENOTDIR, errno.ENOTEMPTY, errno.EPERM, errno.EROFS, errno.EXDEV),
}
"""What the system says of a place that no waiting makes right."""


class CheckpointError(SwitchMTError):
    """No checkpoint of the run can be read whole."""


class ExportError(SwitchMTError):
    """A network, a file or an option cannot be exported or read back."""


class ParityError(SwitchMTError):
    """An exported file does not decide as the trained network does."""

    exit_code = 1


class MissingExtraError(SwitchMTError):
    """An optional package is needed; the message names the extra that installs it."""


class TrainingFailed(SwitchMTError):
    """The run itself failed (a loss that is not finite, a full disk); what was good on disk is kept."""

    exit_code = 1


def shown(value: object) -> str:
    """What code from outside gave, for an error: its repr on one line, or type and shape of a larger array.

    Examples:
        >>> import numpy
        >>> shown(numpy.zeros((2, 84, 84)))
        'a float64 ndarray of shape (2, 84, 84)'
    """
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(shape, tuple) and dtype is not None and math.prod(shape) > _LARGEST_SHOWN:
        return f"a {str(dtype).removeprefix('torch.')} {type(value).__name__} of shape {tuple(shape)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


def printable(text: object) -> str:
    """A text as it may reach a terminal: on one line, without control characters, of at most 500 characters.

    Examples:
        >>> printable("a\\x1b[2J")
        'a\\\\x1b[2J'
    """
    shown = _escaped(str(text)[:501])
    return shown if len(shown) <= 500 else shown[:497] + "..."


def _escaped(text: str) -> str:
    return text if text.isprintable() else "".join(one if one.isprintable() else ascii(one)[1:-1] for one in text)


def reason_of(error: BaseException) -> str:
    """What an exception says, as ``printable``, its lines as one; or its class."""
    return printable(" ".join(str(error).split())) or type(error).__name__


def require_saved(state: object, names: Iterable[str], owner: str) -> None:
    """Refuse a saved state that lacks what its owner reads from it.

    Args:
        state: from a checkpoint.
        names: what is read.
        owner: whose state it is, for the error.

    Raises:
        CheckpointError: the state is no dict, or a name is not in it.
    """
    if not isinstance(state, dict):
        raise CheckpointError(
            f"the checkpoint has a {type(state).__name__} as the state of {owner}, expected a dict of what it saved; "
            "start a new run with --run"
        )
    missing = [name for name in names if name not in state]
    if missing:
        raise CheckpointError(
            f"the checkpoint has no {', '.join(missing)} of {owner}, expected what it saves; if its code or its config "
            "changed, restore it, or start a new run with --run"
        )


def nearest(seen: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest known name, or nothing if none is near."""
    near = difflib.get_close_matches(seen, sorted(known), n=1, cutoff=0.6)
    return f"; did you mean {near[0]!r}?" if near else ""


def did_you_mean(seen: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest known name, or the list of known names if none is near."""
    names = sorted(known)
    return nearest(seen, names) or f"; known: {', '.join(names[:12])}{', ...' if len(names) > 12 else ''}"
