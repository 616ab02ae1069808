"""What every benchmark needs: times with their spread, and the machine that they were taken on."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import torch

from switchmt_snn.learning.run_folder import processor

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
        "processor": processor(),
        "cores": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
    }
