"""Where an exported file or a report comes from."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path
from typing import Any

from switchmt_snn import __version__


def provenance(run: Path | None = None) -> dict[str, Any]:
    """Tool and version, git commit of its source, and the SHA-256 of the run's config, if there is a run."""
    facts = {"tool": f"switchmt-snn {__version__}", "git_commit": _git_commit()}
    if run is not None:
        facts["config_sha256"] = hashlib.sha256((run / "config.yaml").read_bytes()).hexdigest()
    return facts


def _git_commit() -> str:
    """The commit of this package's source, ``+changes`` if files differ from it; ``unknown`` for an installed package.

    An installed package may lie within another project's repository, whose commit says nothing.
    """
    here = Path(__file__).resolve().parent
    try:
        if _git(here, "ls-files", "--error-unmatch", Path(__file__).name) is None:
            return "unknown"
        commit = _git(here, "rev-parse", "HEAD")
        changes = _git(here, "status", "--porcelain", "--untracked-files=no", "--", ":/export", ":/switchmt_snn")
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return "unknown" if commit is None else commit + ("+changes" if changes else "")


def _git(folder: Path, *words: str) -> str | None:
    """What git answers, or None if it refuses."""
    answer = subprocess.run(["git", "-C", folder, *words], capture_output=True, text=True, timeout=10)
    return answer.stdout.strip() if answer.returncode == 0 else None
