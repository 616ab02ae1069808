"""What every benchmark needs: times with their spread, and the machine that they were taken on."""

from __future__ import annotations

import json
import platform
import statistics
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import nn

from switchmt_snn.native.panels import Panels
from switchmt_snn.runs.environment import processor

PACKAGES = ("switchmt-snn", "torch", "snntorch", "numpy", "ale-py", "zstandard", "onnxruntime")


def times_ms(action: Callable[[], object], repeats: int, warmup: int = 1) -> dict[str, Any]:
    """Median, smallest and largest of single calls in milliseconds."""
    for _ in range(warmup):
        action()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        action()
        times.append((time.perf_counter() - started) * 1e3)
    return summary(times)


def matmul_gflops(dtype: torch.dtype, device: str = "cpu", size: int = 2048) -> float:
    """The machine's ceiling for products: the fastest of some square matrix products, in 1e9 operations per second."""
    a, b = (torch.randn(size, size, device=device).to(dtype) for _ in range(2))

    def product() -> None:
        torch.mm(a, b)
        if device == "cuda":
            torch.cuda.synchronize()

    return 2.0 * size**3 / times_ms(product, 10, warmup=2)["min_ms"] / 1e6


def spike_product_gflops(lanes: int = 16384, bits: int = 2048, outputs: int = 256) -> float:
    """The machine's ceiling for products of spikes that are bits, as ``matmul_gflops`` counts operations."""
    panels = Panels.empty(lanes, bits)
    panels.words.random_()
    weight, bias = torch.randn(outputs, bits), torch.zeros(outputs)
    return 2.0 * lanes * bits * outputs / times_ms(lambda: panels.times(weight, bias), 10, warmup=2)["min_ms"] / 1e6


def read_gigabytes_per_s(megabytes: int = 256) -> float:
    """The machine's ceiling for reading: the fastest of some sums over a large array."""
    array = torch.ones(megabytes * 2**18)
    return array.numel() * 4 / times_ms(array.sum, 10, warmup=2)["min_ms"] / 1e6


def network_macs(network: nn.Module, forward: Callable[[], object]) -> dict[nn.Module, float]:
    """Multiply-accumulates of every convolution and linear layer in one call of ``forward``, in forward order."""
    macs: dict[nn.Module, float] = {}

    def count(module: nn.Module, inputs: Any, output: torch.Tensor) -> None:
        macs[module] = float(output.numel() * module.weight[0].numel())  # type: ignore[index, operator, union-attr]

    layers = [module for module in network.modules() if isinstance(module, (nn.Conv2d, nn.Linear))]
    hooks = [module.register_forward_hook(count) for module in layers]
    forward()
    for hook in hooks:
        hook.remove()
    return macs


def interleaved_ms(
    actions: dict[str, Callable[[], object]], repeats: int, warmup: int = 2, calls: int = 1
) -> dict[str, list[float]]:
    """Times of every action in milliseconds.

    Each round runs each action, so that a slow moment of the machine hits all of them. With ``calls`` above 1 a round
    calls it so often, after one call that is not counted: threads of the action before it may still be spinning.
    """
    times: dict[str, list[float]] = {name: [] for name in actions}
    for round_ in range(repeats + warmup):
        for name, action in actions.items():
            if calls > 1:
                action()
            for _ in range(calls):
                started = time.perf_counter()
                action()
                if round_ >= warmup:
                    times[name].append((time.perf_counter() - started) * 1e3)
    return times


def summary(values: list[float]) -> dict[str, Any]:
    """Median and spread of times in milliseconds, and the times."""
    raw = [round(value, 4) for value in values]
    return {"median_ms": statistics.median(values), "min_ms": min(values), "max_ms": max(values), "values_ms": raw}


def rates(values: list[float]) -> dict[str, Any]:
    """Median and spread of rates per second, and the rates."""
    spread = {"median_per_s": statistics.median(values), "min_per_s": min(values), "max_per_s": max(values)}
    return {**spread, "values_per_s": [round(value, 2) for value in values]}


def print_rates(result: dict[str, Any], as_json: bool) -> None:
    """Rates of variants beside the plain loop, as JSON or as a table."""
    if as_json:
        print(json.dumps(result, indent=1))
        return
    print(f"{'variant':46}{'steps/s':>9}{'min':>8}{'max':>8}{'x plain':>9}")
    for name, row in result["variants"].items():
        print(
            f"{name:46}{row['median_per_s']:9.1f}{row['min_per_s']:8.1f}{row['max_per_s']:8.1f}"
            f"{row['faster_than_plain_loop']:9.2f}"
        )


def environment() -> dict[str, Any]:
    """Command, machine and versions."""
    return {
        "command": " ".join(["python -m", f"benchmarks.{Path(sys.argv[0]).stem}", *sys.argv[1:]]),
        "processor": processor(),
        "cores": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
    }
