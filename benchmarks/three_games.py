"""Agent steps per second of the preset `strong` on its three games, by samples per agent step.

``python -m benchmarks.three_games [--turns 4] [--timesteps 4] [--json]``. Pong, Breakout and Enduro take turns of 240
steps, eight copies of each, the full channels, batches of 32 of each game; engine and precision as ``train`` chooses
them. Beside it the plain loop of ``benchmarks.end_to_end`` (Breakout alone, one copy, batches of 32).
A sample is one transition in one gradient step. Variants take turns in one process, with as many threads as cores.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from benchmarks.end_to_end import BATCH, EPSILON, plain_loop
from benchmarks.measure import environment, print_rates, rates
from switchmt_snn.config import load_config
from switchmt_snn.learning.events import Stepped
from switchmt_snn.learning.training import Training
from switchmt_snn.machine.devices import keep_freed_memory
from switchmt_snn.runs.plan import plan

GAMES, COPIES, VISIT, STARTS = 3, 8, 240, 300
FILLED = GAMES * 2 * VISIT  # by then every game's replay is being learned from
SAMPLES = (8, 4)  # per agent step
PLAIN_TURN = 240  # agent steps of the plain loop in a turn; it takes its time


def recipe_loop(steps: int, samples: int, timesteps: int, overlap: bool) -> Iterator[None]:
    """The training loop of ``strong``; yields after every round of the copies."""
    base = load_config("strong")
    updates = GAMES * base.learning.updates_per_round * base.learning.batch_size  # samples of one round of updates
    learning = replace(
        base.learning,
        overlap=overlap,
        learning_starts_steps=STARTS,
        replay_capacity_steps=max(STARTS, steps // GAMES),
        epsilon_start=EPSILON,
        epsilon_end=EPSILON,
        update_every_steps=updates // samples,
    )
    planned = plan(
        replace(
            base,
            total_steps=steps,
            network=replace(base.network, trunk="nature", timesteps=timesteps),
            learning=learning,
            switching=replace(base.switching, min_stay_steps=VISIT, max_stay_steps=VISIT),
        )
    )
    training = Training(planned.config, planned.suite, planned.device)
    for event in training.events():
        if isinstance(event, Stepped):
            yield
    training.close()


def measure(turns: int, timesteps: int) -> dict[str, Any]:
    """Steps per second by variant; a turn is one visit to each game."""
    turn = GAMES * VISIT
    total = FILLED + (turns + 1) * turn
    loops: dict[str, tuple[Iterator[None], int, int]] = {}  # iterator, its steps of a turn, steps of one iteration
    for samples in SAMPLES:
        plain = plain_loop(1000 + (turns + 1) * PLAIN_TURN, BATCH // samples)
        loops[f"plain loop over snn.Leaky, {samples} samples per step"] = (plain, PLAIN_TURN, 1)
        for overlap in (False, True):
            name = f"ours, {samples} samples per step{', overlap' if overlap else ''}"
            loops[name] = (recipe_loop(total, samples, timesteps, overlap), turn, COPIES)
    for loop, _, each in loops.values():
        for _ in range((FILLED if each > 1 else 440) // each):
            next(loop)
    measured: dict[str, list[float]] = {name: [] for name in loops}
    for _ in range(turns):
        for name, (loop, steps, each) in loops.items():
            started = time.perf_counter()
            for _ in range(steps // each):
                next(loop)
            measured[name].append(steps / (time.perf_counter() - started))
    rows = {name: rates(values) for name, values in measured.items()}
    for samples in SAMPLES:
        plain_rate = statistics.median(measured[f"plain loop over snn.Leaky, {samples} samples per step"])
        for name, values in measured.items():
            if f" {samples} samples" in name:
                rows[name]["faster_than_plain_loop"] = statistics.median(values) / plain_rate
    return {"turns": turns, "turn_steps": turn, "timesteps": timesteps, "variants": rows, "environment": environment()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=4, help="measurements of each variant")
    parser.add_argument("--timesteps", type=int, default=4, help="T of ours; the plain loop has 4")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    keep_freed_memory()  # as `train` does
    print_rates(measure(options.turns, options.timesteps), options.json)


if __name__ == "__main__":
    main()
