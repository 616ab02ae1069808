"""Train on Gymnasium environments of your own: my_environment.py registers them, the config names them.

python examples/02_own_environment.py
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from switchmt_snn import load_config, train


def main(words: list[str] | None = None) -> None:
    """Train on the two tasks of my_environment.py and print their scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=8_000, help="agent steps over both tasks")
    parser.add_argument("--run", default="runs/own-environment", help="run folder; an existing one is continued")
    args = parser.parse_args(words)

    config = load_config(Path(__file__).parent / "cartpole.yaml")
    # "module:id" imports the module, which registers the id. The module must be importable wherever the run is used:
    # installed, or in the folder of the script or command.
    names = ("my_environment:Follow-v0", "my_environment:FollowFast-v0")
    config = replace(config, name="follow", total_steps=args.steps, tasks=replace(config.tasks, names=names))
    result = train(config, run=args.run)
    assert result.evaluation is not None, "the run folder holds a finished run; use another --run"
    for task in names:
        agent, random = result.evaluation.score(task).mean, result.evaluation.score(task, policy="random").mean
        print(f"{task}: score {agent:.1f} of 40, random play {random:.1f}")


if __name__ == "__main__":
    main()
