"""Memory that this process may take."""

from __future__ import annotations

import contextlib
import resource
import sys
from pathlib import Path

import psutil
import torch

GIB = 1024**3


_VERSION_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_VERSION_2 = ("memory.max", "memory.current", "inactive_file")
"""Of control groups: files of the limit and of the use, and the line of memory.stat for files that can be dropped."""


def available_bytes() -> int:
    """Memory that this process may still take: the machine's, or less where a control group limits it."""
    left = group_bytes(Path("/sys/fs/cgroup"), Path("/proc/self/cgroup"))
    return min([int(psutil.virtual_memory().available), *left])


def group_bytes(mounted: Path, membership: Path) -> list[int]:
    """What each control group with a limit still leaves to a process: its own groups and those that hold them.

    Files that the kernel only keeps in case they are read again do not count as used: it drops them first.

    Args:
        mounted: where control groups are seen, /sys/fs/cgroup; version 1 has its memory groups in its folder memory.
        membership: /proc/self/cgroup, a line ``id:controllers:/path`` for each hierarchy.

    Returns:
        Bytes of every group with a limit, at least 0; none where there is no limit, or no control groups.
    """
    left = []
    with contextlib.suppress(OSError):
        for line in membership.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers not in ("", "memory"):
                continue
            root, names = (mounted / "memory", _VERSION_1) if controllers else (mounted, _VERSION_2)
            own = root / path.lstrip("/")  # within a container it may be the host's path, which is not seen there
            groups = [group for group in (own, *own.parents) if group.is_relative_to(root)]
            left += [_left_in_group(group, *names) for group in groups]
    return [count for count in left if count is not None]


def _left_in_group(group: Path, limit_name: str, used_name: str, droppable_name: str) -> int | None:
    """Bytes that a control group leaves; None if it has no limit or does not exist."""
    try:
        limit, used = int((group / limit_name).read_text()), int((group / used_name).read_text())
    except (OSError, ValueError):  # version 2 writes "max" for no limit
        return None
    droppable = 0
    with contextlib.suppress(OSError, ValueError):
        lines = (group / "memory.stat").read_text().splitlines()
        droppable = int(dict(line.split(maxsplit=1) for line in lines)[droppable_name])
    return max(0, limit - (used - droppable))


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
