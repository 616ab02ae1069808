"""Errors that a user can act on: every message says what was seen, what was expected and what to do.

The command line prints the message as one line and exits with ``exit_code``; a library user catches the class.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SwitchMTError(Exception):
    """Base of every error that this package raises on purpose.

    ``exit_code`` is 2 for wrong use (the user changes the command) and 1 for a run that failed by itself.
    """

    exit_code = 2


class ConfigError(SwitchMTError):
    """A setting is unknown, of the wrong type, out of range, or contradicts another one."""


class TaskError(SwitchMTError):
    """A task does not exist, cannot be made, or has a space that a Q-network cannot serve."""


class RunFolderError(SwitchMTError):
    """The run folder is missing, foreign, in use, not writable, or holds another config."""


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


def nearest(seen: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest known name, or nothing if none is near."""
    near = difflib.get_close_matches(seen, sorted(known), n=1, cutoff=0.6)
    return f"; did you mean {near[0]!r}?" if near else ""


def did_you_mean(seen: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest known name, or the list of known names if none is near."""
    names = sorted(known)
    return nearest(seen, names) or f"; known: {', '.join(names[:12])}{', ...' if len(names) > 12 else ''}"
