"""Export a run to ONNX and NIR, act with the file, and count what the network does per decision.

python examples/05_export_and_act.py --run runs/cartpole      # the run of 01_train_cartpole.py
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np

from switchmt_snn import load_agent
from switchmt_snn.export import ExportSettings, export, load_exported, profile


def main(words: list[str] | None = None) -> None:
    """Export, compare one decision, play an episode with onnxruntime, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", default="runs/cartpole", help="folder of a finished run")
    parser.add_argument("--decisions", type=int, default=200, help="recorded decisions to compare and count")
    args = parser.parse_args(words)

    # Writes decision.onnx, step.onnx and one .nir file per task, and fails unless they decide like the trained network.
    exported = export(args.run, ExportSettings(parity_decisions=args.decisions))
    print("wrote", ", ".join(sorted(exported.files)), "to", exported.folder)

    trained, deployed = load_agent(args.run, device="cpu"), load_exported(args.run)
    environment = gymnasium.make("CartPole-v1")
    observation, _ = environment.reset(seed=1)
    task = trained.suite.index("CartPole-v1")
    total, over = 0.0, False
    while not over:
        padded = np.zeros((1, *trained.suite.observation_shape), np.float32)  # tasks share the larger one's shape
        padded[0, : len(observation)] = observation
        q = deployed.q_values(padded, task)
        if total == 0.0:
            print("Q-values of the file:", q[0], "of the network:", trained.q_values(padded, task)[0])
        observation, reward, terminated, truncated, _ = environment.step(int(q.argmax()))
        total, over = total + float(reward), terminated or truncated
    print(f"the exported file balanced the pole for {total:.0f} steps")

    counted = profile(args.run, decisions=args.decisions)
    for row in counted.facts["tasks"]:
        mean = row["per_decision"]
        print(f"{row['task']}: {mean['spikes']:.0f} spikes and {mean['acs']:.0f} accumulations per decision")
    print("report:", counted.folder / "report.html")


if __name__ == "__main__":
    main()
