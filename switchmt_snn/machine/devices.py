"""Devices of this machine, their number formats, and the C library's handling of freed memory."""

from __future__ import annotations

import ctypes

import torch

from switchmt_snn.errors import ConfigError


def select_device(wish: str) -> torch.device:
    """The device for a wish.

    Raises:
        ConfigError: the wished device is not there.
    """
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    if wish == "auto":
        return torch.device(next(name for name, present in there.items() if present))
    if not there[wish]:
        present = ", ".join(name for name, is_there in there.items() if is_there)
        raise ConfigError(f"device is {wish!r}, expected one that this machine has ({present}); use device=auto")
    return torch.device(wish)


def has_bfloat16(device: torch.device) -> bool:
    """Whether a device multiplies bfloat16 faster than float32."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    if device.type != "cpu":
        return False
    checks = (getattr(torch.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"))
    return any(check is not None and check() for check in checks)


def keep_freed_memory() -> bool:
    """Let the C library keep what is freed instead of handing it back to the system at once.

    Activations of a large batch are allocated and freed at every update, and fresh pages cost more than the arithmetic
    that is done on them. No number changes, and a process keeps its peak.

    Returns:
        whether the C library (glibc) can be told so.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    trim_threshold, mmap_threshold = -1, -3  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of malloc.h
    # Some versions take no more than 32 MiB.
    unmapped = mallopt(mmap_threshold, 2**30) or mallopt(mmap_threshold, 2**25)
    untrimmed = mallopt(trim_threshold, 2**31 - 1)
    return bool(unmapped and untrimmed)
