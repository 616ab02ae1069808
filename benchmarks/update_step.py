"""One gradient step, ours against peers, interleaved in one process: double DQN, dueling network with dendrites, Adam.

``python -m benchmarks.update_step [--batch 32] [--timesteps 4] [--repeats 15] [--device cpu] [--json]``. All variants
have the same layers and the same random batch. SpikingJelly takes part where it is installed (extra ``simulators``).

The physical limit of a variant is the time of its products alone (forward for Q*, Q and training, backward for weights
and inputs; the first layer once for all T) at the speed of a large matrix product of its precision on this machine.
"""

from __future__ import annotations

import argparse
import copy
import functools
import importlib.util
import json
import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import snntorch
import torch
import torch.nn.functional as F
from snntorch import surrogate
from torch import Tensor, nn

from benchmarks.measure import environment, interleaved_ms, matmul_gflops, summary
from switchmt_snn import config_io
from switchmt_snn.config import ExperimentConfig, resolve
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.replay import Batch
from switchmt_snn.learning.training import observation_spec
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.make import make_suite
from switchmt_snn.tasks.suite import TaskSuite

ACTIONS = 18
PLAIN = "plain loop over snn.Leaky"


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


def peer_update(network: nn.Module, batch: Batch, bf16: bool, device: str) -> Callable[[], None]:
    """The same double-DQN step around somebody else's network."""
    network = network.to(device)
    target = copy.deepcopy(network).eval()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-4, fused=True)
    x, x_next = (torch.from_numpy(o).to(device).float() / 255 for o in (batch.observations, batch.next_observations))
    actions, rewards = torch.from_numpy(batch.actions).to(device)[:, None], torch.from_numpy(batch.rewards).to(device)

    def q(module: nn.Module, inputs: Tensor) -> Tensor:
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
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


def our_learner(config: ExperimentConfig, suite: TaskSuite, device: str) -> Learner:
    """The learner of a run with this config."""
    resolved = resolve(config)
    network = build_network(resolved.network, observation_spec(suite), 1)
    return Learner(network, resolved.learning, suite.valid_actions_KA, torch.device(device), 1)


def update_gigaoperations(learner: Learner, batch: Batch) -> float:
    """Operations of an update's products in 1e9, two for a multiply-accumulate."""
    macs: dict[nn.Module, float] = {}

    def count(module: nn.Module, inputs: Any, output: Tensor) -> None:
        macs[module] = float(output.numel() * module.weight[0].numel())  # type: ignore[index, operator, union-attr]

    layers = [module for module in learner.network.modules() if isinstance(module, (nn.Conv2d, nn.Linear))]
    hooks = [module.register_forward_hook(count) for module in layers]
    learner.act(batch.observations, 0)
    for hook in hooks:
        hook.remove()
    forward, first = sum(macs.values()), next(iter(macs.values()))
    return 2e-9 * (3 * forward + 2 * forward - first)  # no gradient for the observations


def variants(batch_size: int, timesteps: int, device: str) -> tuple[dict[str, Callable[[], None]], dict[str, float]]:
    """Every step by name, the first being the one that ratios refer to; and their limits in milliseconds."""
    base = config_io.load_config("quickstart")
    suite = make_suite(base.tasks)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, batch_size, *suite.observation_shape), np.uint8)
    rewards = rng.normal(size=batch_size).astype(np.float32)
    batch = Batch(frames[0], rng.integers(0, ACTIONS, batch_size), rewards, frames[1], np.zeros(batch_size, np.bool_))
    torch.manual_seed(0)
    gflops = {name: matmul_gflops(getattr(torch, name), device) for name in ("float32", "bfloat16")}
    steps: dict[str, Callable[[], None]] = {PLAIN: peer_update(PlainLoop(timesteps), batch, False, device)}
    limits, precisions = {}, {PLAIN: "float32"}
    if importlib.util.find_spec("spikingjelly"):
        network = spikingjelly_network(timesteps)
        for precision in gflops:
            name = f"SpikingJelly multi-step, {precision}"
            steps[name] = peer_update(copy.deepcopy(network), batch, precision == "bfloat16", device)
            precisions[name] = precision
    work = {}
    for method, label in (("SwitchMT", "ours"), ("DQN_D", "our ANN of the same shape")):
        for precision in gflops:
            for engine in ("eager", "compiled"):
                config = replace(
                    base,
                    network=replace(base.network, method=method, timesteps=timesteps),
                    learning=replace(base.learning, precision=precision, engine=engine),
                )
                learner = our_learner(config, suite, device)
                work[label] = update_gigaoperations(learner, batch)
                name = f"{label}, {precision}, {engine}"
                steps[name] = functools.partial(learner.update, batch, 0)
                limits[name] = work[label] / gflops[precision] * 1e3
    limits |= {name: work["ours"] / gflops[precision] * 1e3 for name, precision in precisions.items()}
    return steps, limits


def measure(batch_size: int, timesteps: int, repeats: int, device: str = "cpu") -> dict[str, Any]:
    """All variants, interleaved."""
    steps, limits = variants(batch_size, timesteps, device)
    if device == "cuda":
        steps = {name: functools.partial(_synchronized, step) for name, step in steps.items()}
    times = interleaved_ms(steps, repeats, warmup=4)
    slowest = statistics.median(times[PLAIN])
    rows = {
        name: {
            **summary(values),
            "faster_than_plain_loop": slowest / statistics.median(values),
            "limit_ms": limits[name],
        }
        for name, values in times.items()
    }
    facts = {"batch": batch_size, "timesteps": timesteps, "repeats": repeats, "device": device}
    return {**facts, "variants": rows, "environment": environment()}


def _synchronized(step: Callable[[], None]) -> None:
    step()
    torch.cuda.synchronize()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--timesteps", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result = measure(options.batch, options.timesteps, options.repeats, options.device)
    if options.json:
        print(json.dumps(result, indent=1))
        return
    print(f"{'variant':38}{'median ms':>10}{'min':>8}{'max':>8}{'x plain':>9}{'limit':>8}")
    for name, row in result["variants"].items():
        print(
            f"{name:38}{row['median_ms']:10.1f}{row['min_ms']:8.1f}{row['max_ms']:8.1f}"
            f"{row['faster_than_plain_loop']:9.2f}{row['limit_ms']:8.1f}"
        )


if __name__ == "__main__":
    main()
