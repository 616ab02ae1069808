"""Devices of this machine, their number formats, and the C library's handling of freed memory."""

from __future__ import annotations

import ctypes

import torch

from switchmt_snn.errors import ConfigError


def select_device(name: str) -> torch.device:
    """The device that a config asks for; ``auto`` takes the first one of cuda, mps and cpu that this machine has.

    Raises:
        ConfigError: an unknown device, or one that this machine does not have.
    """
    available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    if name == "auto":
        return torch.device(next(device for device, is_available in available.items() if is_available))
    if not available.get(name, False):
        present = ", ".join(device for device, is_available in available.items() if is_available)
        raise ConfigError(f"device is {name!r}, expected one that this machine has ({present}); use device=auto")
    return torch.device(name)


def has_bfloat16(device: torch.device) -> bool:
    """Whether a device multiplies bfloat16 faster than float32."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    if device.type != "cpu":
        return False
    checks = (getattr(torch.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"))
    return any(check is not None and check() for check in checks)


def keep_freed_memory() -> bool:
    """Let the C library keep freed memory instead of returning it to the system at once.

    Every update allocates and frees the activations of a large batch, and new pages cost more than the arithmetic on
    them. No result changes; a process keeps its peak memory.

    Returns:
        whether the C library has this setting (glibc).
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
