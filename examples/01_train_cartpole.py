"""Train one spiking network on two Gymnasium tasks and read what the run left. About a minute on one core.

python examples/01_train_cartpole.py
python examples/01_train_cartpole.py --steps 1000 --run runs/glance
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from switchmt_snn import evaluate, load_config, train


def main(words: list[str] | None = None) -> None:
    """Train, read the logs, evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=12_000, help="agent steps over both tasks")
    parser.add_argument("--run", default="runs/cartpole", help="run folder; an existing one is continued")
    args = parser.parse_args(words)

    config = load_config(Path(__file__).parent / "cartpole.yaml")
    result = train(replace(config, total_steps=args.steps), run=args.run)
    print(f"{result.status} at step {result.step}: {result.path}")

    returns = defaultdict(list)
    with (result.path / "episodes.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            returns[row["task"]].append(float(row["return"]))
    for task, values in returns.items():
        print(f"{task}: mean training return {fmean(values[:10]):.1f} at first, {fmean(values[-10:]):.1f} at last")

    with (result.path / "switches.csv").open(newline="") as stream:
        reasons = [row["reason"] for row in csv.DictReader(stream) if row["decision"] == "switch"]
    print(f"{len(reasons)} switches:", ", ".join(f"{reasons.count(r)} by {r}" for r in sorted(set(reasons))))

    scores = evaluate(result.path, episodes=5)
    for task in config.tasks.names:
        agent, random = scores.score(task).mean, scores.score(task, policy="random").mean
        print(f"{task}: score {agent:.1f}, random play {random:.1f}")


if __name__ == "__main__":
    main()
