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
    """The commit of this package's source, or ``unknown`` for an installed package."""
    here = Path(__file__).resolve().parent
    try:
        found = subprocess.run(["git", "-C", here, "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return found.stdout.strip() if found.returncode == 0 else "unknown"
