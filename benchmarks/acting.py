"""Decisions: our network and its ONNX export against the plain loop, interleaved in one process.

``python -m benchmarks.acting [--repeats 12] [--json]``. An untrained network of the quickstart preset; every engine
uses all cores and is called ten times in turn. One decision is what a robot asks for, eight what an evaluation does.
The physical limit is the longer of two: the products at the speed of a large float32 matrix product, and reading every
weight once.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from benchmarks.measure import environment, interleaved_ms, matmul_gflops, network_macs, read_gigabytes_per_s, summary
from benchmarks.peers import PlainLoop
from switchmt_snn.acting.agent import Agent
from switchmt_snn.config import load_config, resolve
from switchmt_snn.export import to_onnx
from switchmt_snn.export.runtimes.agents import OnnxAgent
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.spiking.network import build_network, trainable_parameters
from switchmt_snn.tasks.registry import make_suite

BATCHES = (1, 8)
PLAIN = "plain loop over snn.Leaky"


def engines() -> tuple[dict[str, Callable[[Any], object]], Agent]:
    """Observations ``[B, 4, 84, 84]`` to Q-values, by name, the first being the one that ratios refer to; our agent."""
    config = resolve(load_config("quickstart"))
    suite = make_suite(config.tasks)
    agent = Agent(build_network(config.network, observation_spec(suite), 1), suite, config, torch.device("cpu"), 0)
    exported = OnnxAgent(to_onnx(agent).SerializeToString(), suite, config, threads=torch.get_num_threads())
    plain = PlainLoop(config.network.timesteps).eval()

    def plain_loop(observations: Any) -> object:
        with torch.inference_mode():
            return plain(torch.from_numpy(observations).float() / 255).numpy()

    named: dict[str, Callable[[Any], object]] = {
        PLAIN: plain_loop,
        "ours, PyTorch": lambda observations: agent.q_values(observations, 0),
        "ours, ONNX in onnxruntime": lambda observations: exported.q_values(observations, 0),
    }
    return named, agent


def measure(repeats: int) -> dict[str, Any]:
    """Times per call by batch and engine."""
    rng, batches = np.random.default_rng(0), {}
    named, agent = engines()
    gflops, bandwidth = matmul_gflops(torch.float32), read_gigabytes_per_s()
    weights_ms = trainable_parameters(agent.network) * 4 / bandwidth / 1e6
    for size in BATCHES:
        observations = rng.integers(0, 256, (size, 4, 84, 84), np.uint8)
        calls = {name: lambda act=act, x=observations: act(x) for name, act in named.items()}  # type: ignore[misc]
        times = interleaved_ms(calls, repeats, calls=10)
        macs = network_macs(agent.network, lambda x=observations: agent.q_values(x, 0))  # type: ignore[misc]
        limit_ms = max(2e-6 * sum(macs.values()) / gflops, weights_ms)
        slowest = statistics.median(times[PLAIN])
        batches[str(size)] = {
            name: {
                **summary(values),
                "faster_than_plain_loop": slowest / statistics.median(values),
                "limit_ms": limit_ms,
            }
            for name, values in times.items()
        }
    ceilings = {"float32_gflops": gflops, "read_gigabytes_per_s": bandwidth}
    return {"repeats": repeats, "batches": batches, "ceilings": ceilings, "environment": environment()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=12)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result = measure(options.repeats)
    if options.json:
        print(json.dumps(result, indent=1))
        return
    print(f"{'decisions':>9} {'engine':32}{'median ms':>10}{'min':>8}{'max':>8}{'x plain':>9}{'limit':>8}")
    for size, rows in result["batches"].items():
        for name, row in rows.items():
            print(
                f"{size:>9} {name:32}{row['median_ms']:10.2f}{row['min_ms']:8.2f}{row['max_ms']:8.2f}"
                f"{row['faster_than_plain_loop']:9.2f}{row['limit_ms']:8.2f}"
            )


if __name__ == "__main__":
    main()
