"""One gradient step, ours against peers, interleaved in one process: double DQN, dueling network with dendrites, Adam.

``python -m benchmarks.update_step [--batch 32] [--timesteps 4] [--repeats 15] [--json]``. All variants have the same
layers and the same random batch. SpikingJelly takes part where it is installed (extra ``simulators``).
"""

from __future__ import annotations

import argparse
import copy
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import snntorch
import torch
import torch.nn.functional as F
from snntorch import surrogate
from torch import Tensor, nn

from benchmarks.measure import environment
from switchmt_snn import config_io
from switchmt_snn.config import ExperimentConfig, resolve
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.replay import Batch
from switchmt_snn.learning.training import observation_spec
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.make import make_suite
from switchmt_snn.tasks.suite import TaskSuite

ACTIONS = 18


class PlainLoop(nn.Module):
    """How snnTorch's tutorials write it: every layer at every step, ``snn.Leaky`` with its own state, Q from the mean
    of the heads' outputs."""

    def __init__(self, timesteps: int) -> None:
        super().__init__()
        self.timesteps = timesteps
        self.convolutions = nn.ModuleList([nn.Conv2d(4, 32, 8, 4), nn.Conv2d(32, 64, 4, 2), nn.Conv2d(64, 64, 3, 1)])
        self.norms = nn.ModuleList([nn.BatchNorm2d(32), nn.BatchNorm2d(64), nn.BatchNorm2d(64)])
        self.hidden = nn.ModuleList([nn.Linear(3136, 512), nn.Linear(3136, 512)])
        self.gains = nn.ParameterList([nn.Parameter(torch.zeros(3)) for _ in range(2)])
        self.heads = nn.ModuleList([nn.Linear(512, 1), nn.Linear(512, ACTIONS)])
        leaky = {"beta": 1.0, "spike_grad": surrogate.atan(), "reset_mechanism": "zero", "reset_delay": True}
        self.leaky = nn.ModuleList([snntorch.Leaky(**leaky) for _ in range(5)])

    def forward(self, x: Tensor) -> Tensor:
        membranes = [neuron.init_leaky() for neuron in self.leaky]  # type: ignore[operator]
        total: Tensor | float = 0.0
        for _ in range(self.timesteps):
            s = x
            for i, (convolution, norm) in enumerate(zip(self.convolutions, self.norms, strict=True)):
                s, membranes[i] = self.leaky[i](norm(convolution(s)), membranes[i])
            flat, outputs = s.flatten(1), []
            for j in range(2):
                gated = self.hidden[j](flat) * torch.sigmoid(self.gains[j].max())
                spikes, membranes[3 + j] = self.leaky[3 + j](gated, membranes[3 + j])
                outputs.append(self.heads[j](spikes))
            value, advantage = outputs
            total = total + value + advantage - advantage.mean(1, keepdim=True)
        return total / self.timesteps  # type: ignore[return-value]


def spikingjelly_network(timesteps: int) -> nn.Module:
    """SpikingJelly's multi-step mode: stateless layers see time folded, neurons walk over it."""
    from spikingjelly.activation_based import functional, layer, neuron
    from spikingjelly.activation_based import surrogate as sj_surrogate

    class MultiStep(nn.Module):
        def __init__(self) -> None:
            super().__init__()

            def fires() -> nn.Module:
                return neuron.IFNode(  # type: ignore[no-any-return]
                    v_reset=0.0, surrogate_function=sj_surrogate.ATan(), detach_reset=True, step_mode="m"
                )

            convolutions = []
            for before, after, kernel, stride in ((4, 32, 8, 4), (32, 64, 4, 2), (64, 64, 3, 1)):
                convolutions += [layer.Conv2d(before, after, kernel, stride), layer.BatchNorm2d(after), fires()]
            self.trunk = nn.Sequential(*convolutions, layer.Flatten())
            self.hidden = nn.ModuleList([layer.Linear(3136, 512) for _ in range(2)])
            self.gains = nn.ParameterList([nn.Parameter(torch.zeros(3)) for _ in range(2)])
            self.fires = nn.ModuleList([fires() for _ in range(2)])
            self.heads = nn.ModuleList([layer.Linear(512, n) for n in (1, ACTIONS)])
            functional.set_step_mode(self, "m")

        def forward(self, x: Tensor) -> Tensor:
            functional.reset_net(self)
            features = self.trunk(x.expand(timesteps, *x.shape))
            value, advantage = (
                self.heads[j](self.fires[j](self.hidden[j](features) * torch.sigmoid(self.gains[j].max()))).mean(0)
                for j in range(2)
            )
            return value + advantage - advantage.mean(1, keepdim=True)  # type: ignore[no-any-return]

    return MultiStep()


def peer_update(network: nn.Module, batch: Batch, bf16: bool) -> Callable[[], None]:
    """The same double-DQN step around somebody else's network."""
    target = copy.deepcopy(network).eval()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-4, fused=True)
    x, x_next = (torch.from_numpy(o).float() / 255 for o in (batch.observations, batch.next_observations))
    actions, rewards = torch.from_numpy(batch.actions)[:, None], torch.from_numpy(batch.rewards)

    def q(module: nn.Module, inputs: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            return module(inputs).float()  # type: ignore[no-any-return]

    def step() -> None:
        with torch.no_grad():
            network.eval()
            chosen = q(network, x_next).argmax(1, keepdim=True)
            goal = rewards + 0.99 * q(target, x_next).gather(1, chosen).squeeze(1)
        network.train()
        loss = F.mse_loss(q(network, x).gather(1, actions).squeeze(1), goal)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

    return step


def our_update(config: ExperimentConfig, suite: TaskSuite, batch: Batch) -> Callable[[], None]:
    """The learner's own step."""
    resolved = resolve(config)
    network = build_network(resolved.network, observation_spec(suite), 1)
    learner = Learner(network, resolved.learning, suite.valid_actions_KA, torch.device("cpu"), 1)
    return lambda: learner.update(batch, 0)


def variants(batch_size: int, timesteps: int) -> dict[str, Callable[[], None]]:
    """Every step by name; the first is the one that ratios refer to."""
    base = config_io.load_config("quickstart")
    suite = make_suite(base.tasks)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, batch_size, *suite.observation_shape), np.uint8)
    rewards = rng.normal(size=batch_size).astype(np.float32)
    batch = Batch(frames[0], rng.integers(0, ACTIONS, batch_size), rewards, frames[1], np.zeros(batch_size, np.bool_))
    torch.manual_seed(0)
    steps = {"plain loop over snn.Leaky": peer_update(PlainLoop(timesteps), batch, False)}
    if importlib.util.find_spec("spikingjelly"):
        network = spikingjelly_network(timesteps)
        for precision, bf16 in (("float32", False), ("bfloat16", True)):
            steps[f"SpikingJelly multi-step, {precision}"] = peer_update(copy.deepcopy(network), batch, bf16)
    for method in ("SwitchMT", "DQN_D"):
        for precision in ("float32", "bfloat16"):
            config = replace(
                base,
                network=replace(base.network, method=method, timesteps=timesteps),
                learning=replace(base.learning, precision=precision),
            )
            name = "ours" if method == "SwitchMT" else "our ANN of the same shape"
            steps[f"{name}, {precision}"] = our_update(config, suite, batch)
    return steps


def measure(batch_size: int, timesteps: int, repeats: int) -> dict[str, Any]:
    """Interleaved: every round runs every variant once, so that a slow moment of the machine hits all of them."""
    steps = variants(batch_size, timesteps)
    times: dict[str, list[float]] = {name: [] for name in steps}
    for round_ in range(repeats + 2):
        for name, step in steps.items():
            started = time.perf_counter()
            step()
            if round_ >= 2:
                times[name].append((time.perf_counter() - started) * 1e3)
    slowest = statistics.median(next(iter(times.values())))
    rows = {
        name: {
            "median_ms": statistics.median(values),
            "min_ms": min(values),
            "max_ms": max(values),
            "faster_than_plain_loop": slowest / statistics.median(values),
        }
        for name, values in times.items()
    }
    facts = {"batch": batch_size, "timesteps": timesteps, "repeats": repeats}
    return {**facts, "variants": rows, "environment": environment()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--timesteps", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result = measure(options.batch, options.timesteps, options.repeats)
    if options.json:
        print(json.dumps(result, indent=1))
        return
    print(f"{'variant':38}{'median ms':>10}{'min':>8}{'max':>8}{'x plain':>9}")
    for name, row in result["variants"].items():
        print(
            f"{name:38}{row['median_ms']:10.1f}{row['min_ms']:8.1f}{row['max_ms']:8.1f}"
            f"{row['faster_than_plain_loop']:9.2f}"
        )


if __name__ == "__main__":
    main()
