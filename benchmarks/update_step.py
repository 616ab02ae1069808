"""One gradient step, ours against peers, interleaved in one process: double DQN, dueling network with dendrites, Adam.

``python -m benchmarks.update_step [--batch 32] [--timesteps 4] [--repeats 15] [--device cpu] [--only TEXT ...]
[--hand-memory-back] [--json]``. All variants have the same layers and start from the same random batch of bytes. The
plain loop has PyTorch's default Adam, as tutorials write it; SpikingJelly the fused one, like ours. SpikingJelly takes
part where it is installed (extra ``simulators``); on a GPU it chooses its kernels itself. There, batches lie on the
device, ours runs as a CUDA graph, too, and every variant's peak of memory is given. One that fails is told with its
reason and left out. Our target network is a copy after eight updates. In every round a variant makes three steps in a
row, as in training, and the first, beside what the variant before it left in caches and threads, is not timed.

The physical limit of a variant is the time of its products alone (forward for Q*, Q and training, backward for weights
and inputs; the first layer once for all T) at the speed of a large matrix product of its precision on this machine.
Where native updates keep spikes as bits, products of spikes count at the speed of a large product of bits instead.
"""

from __future__ import annotations

import argparse
import copy
import functools
import importlib.util
import json
import statistics
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.measure import (
    environment,
    interleaved_ms,
    matmul_gflops,
    network_macs,
    spike_product_gflops,
    summary,
)
from benchmarks.peers import ACTIONS, PlainLoop, spikingjelly_network
from switchmt_snn.config import ExperimentConfig, load_config, resolve
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.machine.devices import keep_freed_memory
from switchmt_snn.native import library as native_library
from switchmt_snn.native.supports import spikes_as_bits
from switchmt_snn.replay.ring import Batch
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import TaskSuite

PLAIN = "plain loop over snn.Leaky"


class PeerUpdate:
    """The same double-DQN step around somebody else's network; call it for one step on the batch that it holds."""

    def __init__(self, network: nn.Module, batch: Batch, bf16: bool, device: str, fused_adam: bool = True) -> None:
        self.network = network.to(device)
        self.target = copy.deepcopy(self.network).eval()
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=1e-4, fused=True if fused_adam else None)
        self.bf16, self.device = bf16, device
        self.batch = batch

    def q(self, module: nn.Module, inputs: Tensor) -> Tensor:
        """Q-values, under autocast if asked for."""
        with torch.autocast(self.device, torch.bfloat16, enabled=self.bf16):
            return module(inputs).float()  # type: ignore[no-any-return]

    def __call__(self) -> None:
        """One update."""
        tensors = (torch.as_tensor(getattr(self.batch, field.name)).to(self.device) for field in fields(Batch))
        x, actions, rewards, x_next, terminated, discounts = tensors
        x, x_next = x.float() / 255, x_next.float() / 255
        with torch.no_grad():
            self.network.eval()
            chosen = self.q(self.network, x_next).argmax(1, keepdim=True)
            value = self.q(self.target, x_next).gather(1, chosen).squeeze(1)
            goal = rewards + discounts * value * ~terminated
        self.network.train()
        loss = F.mse_loss(self.q(self.network, x).gather(1, actions[:, None]).squeeze(1), goal)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()


def our_learner(config: ExperimentConfig, suite: TaskSuite, device: str) -> Learner:
    """The learner of a run with this config."""
    resolved = resolve(config)
    network = build_network(resolved.network, observation_spec(suite), 1)
    return Learner(network, resolved.learning, suite.valid_actions_KA, torch.device(device), 1)


def _update(learner: Learner, batch: Batch) -> None:
    if learner.updates == 8:  # of the warm-up; the target's layers fire only with running statistics of the data
        learner.copy_target()
    learner.update(batch, 0)


class Work(NamedTuple):
    """Operations of an update's products in 1e9, two for a multiply-accumulate."""

    of_spikes: float
    """Forward, and for the weights' gradients: one factor is spikes (or activations)."""
    other: float
    """The first layer's, and for the gradients of spikes."""

    @classmethod
    def of(cls, learner: Learner, batch: Batch) -> Work:
        """A learner's, for batches like this one."""
        observations = np.asarray(torch.as_tensor(batch.observations).cpu())
        macs = network_macs(learner.network, lambda: learner.act(observations, 0))
        first, later = next(iter(macs.values())), sum(list(macs.values())[1:])
        return cls(2e-9 * 4 * later, 2e-9 * (4 * first + later))


def variants(batch_size: int, timesteps: int, device: str) -> tuple[dict[str, Callable[[], None]], dict[str, float]]:
    """Every step by name, the first being the one that ratios refer to; and their limits in milliseconds."""
    base = load_config("quickstart")
    suite = make_suite(base.tasks)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, batch_size, *suite.observation_shape), np.uint8)
    rewards = rng.normal(size=batch_size).astype(np.float32)
    terminated, discounts = np.zeros(batch_size, np.bool_), np.full(batch_size, 0.99, np.float32)
    batch = Batch(frames[0], rng.integers(0, ACTIONS, batch_size), rewards, frames[1], terminated, discounts)
    if device == "cuda":  # as with learning.replay_on_device
        x, x_next = torch.from_numpy(frames).to(device)
        batch = replace(batch, observations=x, next_observations=x_next)
    torch.manual_seed(0)
    gflops = {name: matmul_gflops(getattr(torch, name), device) for name in ("float32", "bfloat16")}
    steps: dict[str, Callable[[], None]] = {
        PLAIN: PeerUpdate(PlainLoop(timesteps), batch, False, device, fused_adam=False)
    }
    limits, precisions = {}, {PLAIN: "float32"}
    if importlib.util.find_spec("spikingjelly"):
        network = spikingjelly_network(timesteps)
        for precision in gflops:
            name = f"SpikingJelly multi-step, {precision}"
            steps[name] = PeerUpdate(copy.deepcopy(network), batch, precision == "bfloat16", device)
            precisions[name] = precision
    work = {}
    for method, label in (("SwitchMT", "ours"), ("DQN_D", "our ANN of the same shape")):
        for precision in gflops:
            for engine in ("eager", "compiled", "graph" if device == "cuda" else "native"):
                if engine == "native" and (method == "DQN_D" or native_library.problem()):
                    continue  # made for spikes; built by a C++ compiler
                config = replace(
                    base,
                    network=replace(base.network, method=method, timesteps=timesteps),
                    learning=replace(base.learning, precision=precision, engine=engine),
                )
                learner = our_learner(config, suite, device)
                work[label] = Work.of(learner, batch)
                name = f"{label}, {precision}, {engine}"
                steps[name] = functools.partial(_update, learner, batch)
                has_bits = engine == "native" and spikes_as_bits(getattr(torch, precision))
                of_spikes = spike_product_gflops() if has_bits else gflops[precision]
                limits[name] = 1e3 * (work[label].of_spikes / of_spikes + work[label].other / gflops[precision])
    limits |= {name: sum(work["ours"]) / gflops[precision] * 1e3 for name, precision in precisions.items()}
    return steps, limits


def measure(batch_size: int, timesteps: int, repeats: int, device: str, only: list[str]) -> dict[str, Any]:
    """The plain loop and all variants (or those whose name has one of the texts in it), interleaved."""
    steps, limits = variants(batch_size, timesteps, device)
    if only:
        chosen = [name for name in steps if any(text in name for text in only)]
        if not chosen:
            raise SystemExit(f"--only is {' '.join(only)}, expected a text in one of: {'; '.join(steps)}")
        steps = {name: steps[name] for name in (PLAIN, *chosen) if name in steps}
    failed, peaks_mib = {}, {}
    for name, step in list(steps.items()):
        steps[name] = functools.partial(_synchronized, step) if device == "cuda" else step
        try:
            steps[name]()
            if device == "cuda":
                peaks_mib[name] = _peak_mib(steps[name])
        except Exception as error:
            failed[name] = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            del steps[name]
    times = interleaved_ms(steps, repeats, warmup=4, calls=2)
    slowest = statistics.median(times[PLAIN])
    rows = {
        name: {
            **summary(values),
            "faster_than_plain_loop": slowest / statistics.median(values),
            "limit_ms": limits[name],
            **({"peak_mib": peaks_mib[name]} if name in peaks_mib else {}),
        }
        for name, values in times.items()
    }
    facts = {"batch": batch_size, "timesteps": timesteps, "repeats": repeats, "device": device}
    return {**facts, "variants": rows, **({"failed": failed} if failed else {}), "environment": environment()}


def _peak_mib(step: Callable[[], None]) -> float:
    """What a variant takes of the device's memory beyond what all of them hold."""
    for _ in range(6):  # compiles, captures
        step()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    step()
    return (torch.cuda.max_memory_allocated() - before) / 2**20


def _synchronized(step: Callable[[], None]) -> None:
    step()
    torch.cuda.synchronize()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=32, help="transitions of an update")
    parser.add_argument("--timesteps", type=int, default=4, help="simulation steps T")
    parser.add_argument("--repeats", type=int, default=15, help="rounds in which every variant has two timed steps")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where all variants run")
    parser.add_argument("--only", nargs="*", default=[], metavar="TEXT", help="variants with such a text in their name")
    parser.add_argument("--hand-memory-back", action="store_true", help="leave the C library's memory settings alone")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    for name, least in (("batch", 2), ("timesteps", 1), ("repeats", 1)):
        if getattr(options, name) < least:
            parser.error(f"--{name} is {getattr(options, name)}, expected at least {least}")
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device is cuda, expected a machine with a CUDA device and a torch built for it; use cpu")
    if not options.hand_memory_back:
        keep_freed_memory()  # as `train` does
    result = measure(options.batch, options.timesteps, options.repeats, options.device, options.only)
    if options.json:
        print(json.dumps(result, indent=1))
        return
    print(f"{'variant':38}{'median ms':>10}{'min':>8}{'max':>8}{'x plain':>9}{'limit':>8}")
    for name, row in result["variants"].items():
        print(
            f"{name:38}{row['median_ms']:10.1f}{row['min_ms']:8.1f}{row['max_ms']:8.1f}"
            f"{row['faster_than_plain_loop']:9.2f}{row['limit_ms']:8.1f}"
            + (f"  {row['peak_mib']:,.0f} MiB" if "peak_mib" in row else "")
        )
    for name, reason in result.get("failed", {}).items():
        print(f"{name:38} failed: {reason}")


if __name__ == "__main__":
    main()
