"""What every benchmark needs: times with their spread, and the machine that they were taken on."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import torch

PACKAGES = ("switchmt-snn", "torch", "snntorch", "numpy", "ale-py", "zstandard", "onnxruntime")


def times_ms(action: Callable[[], object], repeats: int, warmup: int = 1) -> dict[str, float]:
    """Median, smallest and largest of single calls in milliseconds."""
    for _ in range(warmup):
        action()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        action()
        times.append((time.perf_counter() - started) * 1e3)
    return {"median_ms": statistics.median(times), "min_ms": min(times), "max_ms": max(times)}


def environment() -> dict[str, Any]:
    """Machine and versions."""
    return {
        "processor": _processor(),
        "cores": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
    }


def _processor() -> str:
    with open("/proc/cpuinfo", encoding="utf-8") as lines:
        return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
