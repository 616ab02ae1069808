"""Agent steps per second of the whole training loop, ours against a plain loop on the same network and ratio.

``python -m benchmarks.end_to_end [--steps 400] [--rounds 5] [--json]``. Breakout, batch 32, one update per 4 steps,
T = 4, one environment, epsilon 0.1. The plain loop is written as CleanRL's DQN is: Gymnasium's wrappers, both stacks of
every transition in arrays, ``snn.Leaky`` stepped one by one (benchmarks/peers.py), double Q-learning. Variants take
turns in one process.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchmarks.environments import wrapped_game
from benchmarks.measure import environment, print_rates, rates
from benchmarks.peers import ACTIONS, PlainLoop
from benchmarks.update_step import PeerUpdate
from switchmt_snn.config import load_config, resolve
from switchmt_snn.learning.events import Stepped
from switchmt_snn.learning.training import Training
from switchmt_snn.machine.devices import keep_freed_memory
from switchmt_snn.replay.ring import Batch
from switchmt_snn.tasks.registry import make_suite

GAME = "breakout"
BATCH, UPDATE_EVERY, WARM_UP, EPSILON = 32, 4, 400, 0.1
PLAIN = "plain loop over snn.Leaky"
OURS: dict[str, dict[str, Any]] = {
    "ours, eager": {"engine": "eager"},
    "ours, compiled": {"engine": "compiled"},
    "ours, native": {"engine": "native"},
    "ours, compiled, bfloat16": {"engine": "compiled", "precision": "bfloat16"},
    "ours, native, bfloat16": {"engine": "native", "precision": "bfloat16"},
    "ours, native, bfloat16, overlap": {"engine": "native", "precision": "bfloat16", "overlap": True},
}


def plain_loop(steps: int, update_every: int = UPDATE_EVERY) -> Iterator[None]:
    """A DQN loop without tricks; yields after every agent step."""
    rng = np.random.default_rng(0)
    env, network = wrapped_game(GAME), PlainLoop(4)
    stacks = np.zeros((2, steps, 4, 84, 84), np.uint8)
    actions, rewards = np.zeros(steps, np.int64), np.zeros(steps, np.float32)
    terminals = np.zeros(steps, np.bool_)

    def sample(held: int) -> Batch:
        chosen = rng.integers(0, held, BATCH)
        discounts = np.full(BATCH, 0.99, np.float32)
        return Batch(
            stacks[0, chosen], actions[chosen], rewards[chosen], stacks[1, chosen], terminals[chosen], discounts
        )

    update = PeerUpdate(network, sample(1), False, "cpu", fused_adam=False)
    observation, _ = env.reset(seed=0)
    for step in range(steps):
        action = int(rng.integers(ACTIONS))
        if step >= WARM_UP and rng.random() >= EPSILON:
            network.eval()
            with torch.inference_mode():
                action = int(network(torch.from_numpy(np.asarray(observation)[None]).float() / 255).argmax())
        following, reward, terminated, truncated, _ = env.step(action)
        stacks[0, step], stacks[1, step] = observation, following
        actions[step], rewards[step], terminals[step] = action, float(np.clip(reward, -1.0, 1.0)), terminated
        observation = env.reset()[0] if terminated or truncated else following
        if step >= WARM_UP and step % update_every == 0:
            update.batch = sample(step)
            update()
        yield
    env.close()


def our_loop(steps: int, **learning: Any) -> Iterator[None]:
    """The training loop itself; yields after every agent step."""
    base = load_config("quickstart")
    config = resolve(
        replace(
            base,
            total_steps=steps,
            tasks=replace(base.tasks, names=(GAME,), num_envs=1),
            network=replace(base.network, method="SwitchMT", timesteps=4),
            learning=replace(
                base.learning,
                batch_size=BATCH,
                learning_starts_steps=WARM_UP,
                update_every_steps=UPDATE_EVERY,
                replay_capacity_steps=max(steps, 2_000),
                epsilon_start=EPSILON,
                epsilon_end=EPSILON,
                **learning,
            ),
        )
    )
    training = Training(config, make_suite(config.tasks), torch.device("cpu"))
    for event in training.events():
        if isinstance(event, Stepped):
            yield
    training.close()


def measure(steps: int, rounds: int) -> dict[str, Any]:
    """Steps per second by variant, after its warm-up and first updates."""
    total = WARM_UP + 40 + (rounds + 1) * steps
    makers: dict[str, Callable[[], Iterator[None]]] = {PLAIN: lambda: plain_loop(total)}
    for name, learning in OURS.items():
        makers[name] = lambda learning=learning: our_loop(total, **learning)  # type: ignore[misc]
    loops = {name: make() for name, make in makers.items()}
    measured: dict[str, list[float]] = {name: [] for name in loops}
    for loop in loops.values():
        for _ in range(WARM_UP + 40):
            next(loop)
    for _ in range(rounds):
        for name, loop in loops.items():
            started = time.perf_counter()
            for _ in range(steps):
                next(loop)
            measured[name].append(steps / (time.perf_counter() - started))
    slowest = statistics.median(measured[PLAIN])
    rows = {
        name: {**rates(values), "faster_than_plain_loop": statistics.median(values) / slowest}
        for name, values in measured.items()
    }
    return {"steps": steps, "rounds": rounds, "variants": rows, "environment": environment()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=400, help="agent steps per measurement")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    keep_freed_memory()  # as `train` does
    print_rates(measure(options.steps, options.rounds), options.json)


if __name__ == "__main__":
    main()
