"""Environment steps per second: ours (stacks and journal included) against Gymnasium's Atari wrappers.

``python -m benchmarks.environments [--steps 4000] [--json]``. Random actions, no learning. Gymnasium's is one copy with
AtariPreprocessing and FrameStackObservation, as CleanRL and SB3 use it; ours steps copies on threads.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import ale_py
import gymnasium
import numpy as np
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

from benchmarks.measure import environment, rates
from switchmt_snn.config import load_config, resolve
from switchmt_snn.tasks.play import Play
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import TaskSuite

COPIES = (1, 4, 16)
ROUNDS = 5


def wrapped_game(name: str) -> gymnasium.Env[Any, Any]:
    """One copy as CleanRL and SB3 make it."""
    gymnasium.register_envs(ale_py)
    title = "".join(part.capitalize() for part in name.split("_"))
    env = gymnasium.make(f"ALE/{title}-v5", frameskip=1, repeat_action_probability=0.0, full_action_space=True)
    return FrameStackObservation(AtariPreprocessing(env, noop_max=30, frame_skip=4), 4)


def gymnasium_steps(env: gymnasium.Env[Any, Any], rng: np.random.Generator, steps: int) -> None:
    """Play a wrapped game."""
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(int(rng.integers(18)))
        if terminated or truncated:
            env.reset()


def our_steps(play: Play, rng: np.random.Generator, steps: int) -> None:
    """Play copies; an ended episode starts again."""
    for _ in range(steps // play.num_envs):
        ended = np.flatnonzero(play.over)
        if len(ended):
            play.begin(ended, rng.integers(0, 2**31, len(ended)))
        play.step(rng.integers(0, 18, play.num_envs))


def measure(steps: int) -> dict[str, Any]:
    """Every game of the quickstart."""
    suite: TaskSuite = make_suite(resolve(load_config("quickstart")).tasks)
    games = {}
    for task, name in enumerate(suite.names):
        env, rng = wrapped_game(name), np.random.default_rng(0)
        env.reset(seed=0)
        runners: dict[str, Callable[[int], None]] = {"gymnasium, 1 copy": partial(gymnasium_steps, env, rng)}
        plays = [Play(suite, task, copies) for copies in COPIES]
        for play in plays:
            runners[f"ours, {play.num_envs} copies"] = partial(our_steps, play, rng)
        measured: dict[str, list[float]] = {key: [] for key in runners}
        for _ in range(ROUNDS):
            for key, runner in runners.items():
                started = time.perf_counter()
                runner(steps)
                measured[key].append(steps / (time.perf_counter() - started))
        for play in plays:
            play.close()
        env.close()
        games[name] = {key: rates(values) for key, values in measured.items()}
    return {"steps": steps, "rounds": ROUNDS, "games": games, "environment": environment()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=4_000, help="agent steps per measurement")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result = measure(options.steps)
    if options.json:
        print(json.dumps(result, indent=1))
        return
    print(f"{'game':12}{'environment':22}{'steps/s':>9}{'min':>8}{'max':>8}")
    for name, rows in result["games"].items():
        for key, row in rows.items():
            print(f"{name:12}{key:22}{row['median_per_s']:9,.0f}{row['min_per_s']:8,.0f}{row['max_per_s']:8,.0f}")


if __name__ == "__main__":
    main()
