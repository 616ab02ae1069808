"""Train with a neuron model of your own: my_neuron.py defines it, the config names it.

python examples/04_own_neuron.py
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from my_neuron import RefractoryIF

from switchmt_snn import load_config, train
from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ExportError
from switchmt_snn.export import export


def main(words: list[str] | None = None) -> None:
    """Look at the neuron alone, train a network of it, and see what an export says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=8_000, help="agent steps over both tasks")
    parser.add_argument("--run", default="runs/own-neuron", help="run folder; an existing one is continued")
    args = parser.parse_args(words)

    # One neuron with a constant current of 0.6: it fires at every third step, because it skips the one after a spike.
    spikes, _ = RefractoryIF(NetworkConfig())(torch.full((9, 1), 0.6))
    print("spikes of one neuron:", spikes.flatten().int().tolist())

    config = load_config(Path(__file__).parent / "cartpole.yaml")
    network = replace(config.network, neuron="my_neuron:RefractoryIF")
    result = train(replace(config, name="refractory", total_steps=args.steps, network=network), run=args.run)
    assert result.evaluation is not None, "the run folder holds a finished run; use another --run"
    for task in config.tasks.names:
        print(f"{task}: score {result.evaluation.score(task).mean:.1f}")

    try:
        export(result.path)
    except ExportError as error:  # no export rule for this neuron: it is refused by name, not written as another neuron
        print("export:", error)


if __name__ == "__main__":
    main()
