"""Replay memory: bytes per transition and speed on real play, compressed against plain.

``python -m benchmarks.replay [--run RUN] [--steps 20000] [--json]``: frames of a random policy, or of a run's agent.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.measure import environment, times_ms
from benchmarks.peers import StackReplay
from switchmt_snn.acting.agent import Agent
from switchmt_snn.config import load_config, resolve
from switchmt_snn.errors import SwitchMTError
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.machine.devices import keep_freed_memory
from switchmt_snn.replay.ring import FrameReplay, Returns
from switchmt_snn.runs.trained import load_agent
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import TaskSuite

ENVS = 4
EPSILON = 0.05
STACKED_STEPS = 10_000
"""Transitions that the memories of whole stacks hold; 0.5 GiB."""
LAYOUTS = {
    "compressed": "ours, compressed",
    "plain": "ours, plain (frames once)",
    "stacks, one": "stacks once (SB3, optimize_memory_usage)",
    "stacks, both": "both stacks (SB3, CleanRL)",
}


def record(suite: TaskSuite, task: int, agent: Agent | None, steps: int) -> tuple[list[tuple[Any, ...]], float]:
    """Events of real play, and seconds per environment step: ``("begin", lane, frame)``, ``("add", lane, ...)``."""
    play, rng = Play(suite, task, ENVS), np.random.default_rng([1, task])
    valid = np.flatnonzero(suite.valid_actions_KA[task])
    events: list[tuple[Any, ...]] = []
    episodes, spent = 0, 0.0
    for _ in range(steps // ENVS):
        over = np.flatnonzero(play.over)
        if len(over):
            seeds = np.asarray([episode_seed(1, task, episodes + i) for i in range(len(over))])
            frames = play.begin(over, seeds)
            events += [("begin", int(lane), frame.copy()) for lane, frame in zip(over, frames, strict=True)]
            episodes += len(over)
        actions = valid[rng.integers(0, len(valid), ENVS)]
        if agent is not None:
            greedy = rng.random(ENVS) >= EPSILON
            actions = np.where(greedy, agent.q_values(play.observations, task).argmax(axis=-1), actions)
        started = time.perf_counter()
        result = play.step(actions)
        spent += time.perf_counter() - started
        for lane in range(ENVS):
            done = bool(result.terminated[lane])
            step = (int(actions[lane]), float(result.rewards[lane]), done, result.frames[lane].copy())
            events.append(("add", lane, *step))
    play.close()
    return events, spent / steps


def fill(replay: FrameReplay, events: list[tuple[Any, ...]]) -> float:
    """Seconds per added transition."""
    started = time.perf_counter()
    for kind, lane, *rest in events:
        if kind == "begin":
            replay.begin(lane, *rest)
        else:
            replay.add(lane, *rest)
    return (time.perf_counter() - started) / sum(kind == "add" for kind, *_ in events)


def fill_stacks(replay: StackReplay, events: list[tuple[Any, ...]], shape: tuple[int, ...]) -> float:
    """Seconds per added transition of a memory of whole stacks; making the stacks is not counted."""
    stacks: dict[int, Any] = {}
    spent = 0.0
    for kind, lane, *rest in events:
        if kind == "begin":
            stacks[lane] = np.zeros(shape, np.uint8)
            stacks[lane][-1:] = rest[0]
            continue
        action, reward, done, frame = rest
        following = np.concatenate([stacks[lane][1:], frame])
        started = time.perf_counter()
        replay.add(stacks[lane], action, reward, done, following)
        spent += time.perf_counter() - started
        stacks[lane] = following
        if replay.held == len(replay.actions):
            break
    return spent / replay.held


def measure(run: str | None, steps: int, repeats: int) -> dict[str, Any]:
    """Every game of the run, or of the quickstart."""
    agent = load_agent(run, device="cpu") if run is not None else None
    config = agent.config if agent is not None else resolve(load_config("quickstart"))
    suite = agent.suite if agent is not None else make_suite(config.tasks)
    network = build_network(config.network, observation_spec(suite), 1)
    learner = Learner(network, config.learning, suite.valid_actions_KA, torch.device("cpu"), 1)
    games = {}
    for task, name in enumerate(suite.names):
        events, step_s = record(suite, task, agent, steps)
        game: dict[str, Any] = {"env_step_us": step_s * 1e6}
        for kind, compressed in (("plain", False), ("compressed", True)):
            shape = (suite.frame_shape, suite.frame_dtype, suite.frame_stack)
            replay = FrameReplay(len(events) + ENVS * 64, ENVS, *shape, compressed)
            add_s = fill(replay, events)
            rng = np.random.default_rng(0)
            game[kind] = {
                "bytes_per_transition": replay.nbytes / len(replay),
                "add_us": add_s * 1e6,
                **{f"sample_{b}": times_ms(partial(replay.sample, b, rng), repeats) for b in (32, 512)},
            }
            if compressed:
                for batch_size, count in ((32, repeats), (512, 2)):
                    batch = replay.sample(batch_size, rng, Returns())
                    game[f"update_{batch_size}"] = times_ms(partial(learner.update, batch, task), count)
        for kind, twice in (("stacks, both", True), ("stacks, one", False)):
            stacked = StackReplay(STACKED_STEPS, suite.observation_shape, twice)
            add_s = fill_stacks(stacked, events, suite.observation_shape)
            rng = np.random.default_rng(0)
            game[kind] = {
                "bytes_per_transition": stacked.nbytes / stacked.held,
                "add_us": add_s * 1e6,
                **{f"sample_{b}": times_ms(partial(stacked.sample, b, rng), repeats) for b in (32, 512)},
            }
        games[name] = game
    observation = int(np.prod(suite.observation_shape)) * np.dtype(suite.frame_dtype).itemsize
    return {
        "policy": "random" if run is None else f"agent after {agent.step} steps, epsilon {EPSILON}",  # type: ignore[union-attr]
        "steps_per_game": steps,
        "games": games,
        "mean_bytes_per_transition": float(
            np.mean([game["compressed"]["bytes_per_transition"] for game in games.values()])
        ),
        "layouts_bytes_per_transition": {
            "two stacks of float32": 8 * observation,
            "two stacks of uint8 (SB3)": 2 * observation,
            "one stack of uint8 (SB3, optimize_memory_usage)": observation,
        },
        "environment": environment(),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", help="a run whose agent plays; default: random actions")
    parser.add_argument("--steps", type=int, default=20_000, help="agent steps per game")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    keep_freed_memory()  # as `train` does
    try:
        result = measure(options.run, options.steps, options.repeats)
    except SwitchMTError as error:  # such as a run that is not there
        parser.exit(error.exit_code, f"{error}\n")
    if options.json:
        print(json.dumps(result, indent=1))
        return
    print(f"policy: {result['policy']}; {result['steps_per_game']:,} steps per game")
    print(
        f"{'game':10}{'layout':42}{'bytes':>8}{'add us':>8}{'of step':>9}"
        f"{'B=32 ms':>9}{'of update':>10}{'B=512 ms':>10}{'of update':>10}"
    )
    for name, game in result["games"].items():
        for kind, label in LAYOUTS.items():
            row = game[kind]
            small, large = (row[f"sample_{b}"]["median_ms"] for b in (32, 512))
            shares = [s / game[f"update_{b}"]["median_ms"] for s, b in ((small, 32), (large, 512))]
            print(
                f"{name:10}{label:42}{row['bytes_per_transition']:8,.0f}{row['add_us']:8.1f}"
                f"{row['add_us'] / game['env_step_us']:9.1%}{small:9.2f}{shares[0]:10.1%}{large:10.1f}{shares[1]:10.1%}"
            )
    print(f"mean: {result['mean_bytes_per_transition']:.0f} bytes per transition")


if __name__ == "__main__":
    main()
