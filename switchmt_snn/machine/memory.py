"""Memory that this process may take."""

from __future__ import annotations

import contextlib
import resource
import sys
from pathlib import Path

import psutil
import torch

GIB = 1024**3


def available_bytes() -> int:
    """Memory that this process may still take: the machine's, or less where a control group limits it."""
    available = int(psutil.virtual_memory().available)
    with contextlib.suppress(OSError, ValueError):
        limit = int(Path("/sys/fs/cgroup/memory.max").read_text())
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
        available = min(available, limit - used)
    return available


def peak_bytes() -> int:
    """The largest memory that this process has had so far.

    Linux hands ``ru_maxrss`` on to the programs that a process starts: one that a large process has started would state
    the memory of that one. VmHWM is of this program alone.
    """
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024  # the kernel writes KiB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # macOS counts bytes, Linux KiB


def peak_device_bytes() -> int | None:
    """The largest memory that tensors on a GPU have had so far; None if this process uses none."""
    return int(torch.cuda.max_memory_allocated()) if torch.cuda.is_initialized() else None
