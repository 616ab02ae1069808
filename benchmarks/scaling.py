"""How cost grows: an update against T, batch and number of tasks, a sample against the size of the replay.

``python -m benchmarks.scaling [--repeats 7] [--json]``. The 84x84 dueling network with dendrites in float32, eager; one
thing is varied at a time from batch 32, T = 4, 3 tasks. Values of one thing take turns in one process.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.measure import environment, interleaved_ms, summary
from switchmt_snn.config import load_config, resolve
from switchmt_snn.learning.learner import Learner
from switchmt_snn.machine.devices import keep_freed_memory
from switchmt_snn.replay.ring import Batch, FrameReplay
from switchmt_snn.spiking.network import ObservationSpec, build_network, trainable_parameters
from switchmt_snn.tasks.play import Play
from switchmt_snn.tasks.registry import make_suite

ACTIONS = 18
BASE = {"timesteps": 4, "batch_size": 32, "tasks": 3}
VALUES = {"timesteps": (1, 2, 4, 8, 16), "batch_size": (16, 32, 64, 128), "tasks": (1, 3, 8, 16, 26)}
REPLAY_SIZES = (10_000, 30_000, 100_000, 300_000)


def learner_of(timesteps: int, batch_size: int, tasks: int) -> tuple[Learner, Batch]:
    """A learner of that size, and a random batch of its last task."""
    config = load_config("quickstart")
    network = replace(config.network, method="SwitchMT", timesteps=timesteps, dendritic_segments=tasks)
    config = resolve(replace(config, network=network, learning=replace(config.learning, engine="eager")))
    observation = ObservationSpec((4, 84, 84), 4, 1 / 255, True, ACTIONS, tasks)
    valid = np.ones((tasks, ACTIONS), np.bool_)
    learner = Learner(build_network(config.network, observation, 1), config.learning, valid, torch.device("cpu"), 1)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, batch_size, 4, 84, 84), np.uint8)
    rewards = rng.normal(size=batch_size).astype(np.float32)
    actions = rng.integers(0, ACTIONS, batch_size)
    terminated, discounts = np.zeros(batch_size, np.bool_), np.full(batch_size, 0.99, np.float32)
    return learner, Batch(frames[0], actions, rewards, frames[1], terminated, discounts)


def updates(repeats: int) -> dict[str, Any]:
    """Update times for every value of every thing."""
    table: dict[str, Any] = {}
    for thing, values in VALUES.items():
        actions, parameters = {}, {}
        for value in values:
            learner, batch = learner_of(**{**BASE, thing: value})
            actions[str(value)] = partial(learner.update, batch, BASE["tasks"] - 1 if thing != "tasks" else value - 1)
            parameters[str(value)] = trainable_parameters(learner.network)
        times = interleaved_ms(actions, repeats)
        table[thing] = {name: {**summary(each), "parameters": parameters[name]} for name, each in times.items()}
    return table


def samples(repeats: int) -> dict[str, Any]:
    """Sampling 32 and 512 of compressed replays filled with real play of Breakout (repeated), and their bytes."""
    suite = make_suite(resolve(load_config("quickstart")).tasks)
    play, rng = Play(suite, suite.index("breakout"), 1), np.random.default_rng(0)
    episodes = []
    for seed in range(20):
        episodes.append([play.begin(np.asarray([0]), np.asarray([seed]))[0].copy()])
        while not play.over[0]:
            episodes[-1].append(play.step(rng.integers(0, 18, 1)).frames[0].copy())
    play.close()
    replays = {}
    for size in REPLAY_SIZES:
        replay = FrameReplay(size, 1, suite.frame_shape, suite.frame_dtype, suite.frame_stack, True)
        while replay.transitions_added < size:
            for index, frames in enumerate(episodes):
                replay.begin(0, frames[0])
                for step, frame in enumerate(frames[1:], start=2):
                    replay.add(0, index % 18, 0.0, step == len(frames), frame)
        replays[size] = replay
    table: dict[str, Any] = {}
    for batch in (32, 512):
        actions = {str(size): partial(replay.sample, batch, rng) for size, replay in replays.items()}
        for name, times in interleaved_ms(actions, 3 * repeats).items():
            row = table.setdefault(name, {"bytes_per_transition": replays[int(name)].nbytes / len(replays[int(name)])})
            row[f"sample_{batch}"] = summary(times)
    return table


def measure(repeats: int) -> dict[str, Any]:
    """Everything."""
    return {
        "repeats": repeats,
        "base": BASE,
        **updates(repeats),
        "replay": samples(repeats),
        "environment": environment(),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    keep_freed_memory()  # as `train` does
    result = measure(options.repeats)
    if options.json:
        print(json.dumps(result, indent=1))
        return
    for thing in VALUES:
        for value, row in result[thing].items():
            print(
                f"{thing:12}{value:>9}  update {row['median_ms']:8.1f} ms ({row['min_ms']:.1f} to {row['max_ms']:.1f})"
            )
    for size, row in result["replay"].items():
        times = ", ".join(f"{batch}: {row[f'sample_{batch}']['median_ms']:.2f} ms" for batch in (32, 512))
        print(f"{'replay':12}{int(size):>9,}  sample {times}; {row['bytes_per_transition']:.0f} bytes per transition")


if __name__ == "__main__":
    main()
