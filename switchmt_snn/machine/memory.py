"""Memory that this process may take."""

from __future__ import annotations

import contextlib
from pathlib import Path

import psutil

GIB = 1024**3


def available_bytes() -> int:
    """Memory that this process may still take: the machine's, or less where a control group limits it."""
    available = int(psutil.virtual_memory().available)
    with contextlib.suppress(OSError, ValueError):
        limit = int(Path("/sys/fs/cgroup/memory.max").read_text())
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
        available = min(available, limit - used)
    return available
