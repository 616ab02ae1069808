"""Train with a switching policy of your own: my_policy.py defines it, `train` takes it.

python examples/03_own_policy.py
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import replace
from pathlib import Path

from my_policy import ReturnAbove

from switchmt_snn import load_config, train


def main(words: list[str] | None = None) -> None:
    """Train with the policy and print its decisions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=8_000, help="agent steps over both tasks")
    parser.add_argument("--run", default="runs/own-policy", help="run folder; an existing one is continued")
    args = parser.parse_args(words)

    config = load_config(Path(__file__).parent / "cartpole.yaml")
    # The config's bounds hold for every policy: no visit is shorter than min_stay_steps or longer than max_stay_steps.
    result = train(replace(config, name="return-above", total_steps=args.steps), run=args.run, policy=ReturnAbove)
    with (result.path / "switches.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            if row["decision"] == "switch":
                mean = f"mean return {float(row['mean_return']):.1f}" if row["mean_return"] else "within an episode"
                print(f"step {row['step']}: {row['task']} -> {row['next_task']} by {row['reason']} ({mean})")


if __name__ == "__main__":
    main()
