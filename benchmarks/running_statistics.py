"""Whether the network that acts is the one that learns: BatchNorm's running statistics of a stored run.

``python -m benchmarks.running_statistics RUN [--out FILE.csv]``. The newest checkpoint's network plays with running
statistics; it learns with those of the batch. For each task both give Q-values of the same observations from the
replay: the second set with statistics that were estimated anew, over many batches. Written for each task: the
correlation of their largest Q-values, how often both choose the same action, and their means, also those of the target
network; and for each layer how far the running mean is off, in standard deviations of its currents.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks.restored import drawn, q_values, restored, tasks_learned, write_rows
from switchmt_snn.learning.statistics import reestimate_statistics
from switchmt_snn.learning.training import Training
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.spiking.normalization import TaskBatchNorm

BATCHES, BATCH_SIZE, SEED = 16, 64, 0


def rows(run: Path) -> Iterator[dict[str, Any]]:
    """One row for each task of a run's newest checkpoint."""
    with restored(run) as training:
        for task, name in tasks_learned(training):
            yield {"run": run.name, "step": training.steps, "task": name, **_compare(training, task)}


def _compare(training: Training, task: int) -> dict[str, float]:
    device = training.learner.device
    running, target = training.learner.network.eval(), training.learner.target
    seen = drawn(training, task, 2 * BATCHES, BATCH_SIZE, SEED)
    fresh, fresh_target = copy.deepcopy(running), copy.deepcopy(target)
    for network in (fresh, fresh_target):
        reestimate_statistics(network, task, (x.to(device) for x in seen[:BATCHES]), torch.Generator(device))
    valid = torch.from_numpy(training.suite.valid_actions_KA[task])
    networks = (running, fresh, target, fresh_target)
    ours, theirs, targets, fresh_targets = (q_values(net, seen[BATCHES:], task)[:, valid] for net in networks)
    largest = torch.stack([ours.amax(1), theirs.amax(1)])
    return {
        "correlation": float(torch.corrcoef(largest)[0, 1]),
        "same_action": float((ours.argmax(1) == theirs.argmax(1)).float().mean()),
        "q_running": float(largest[0].mean()),
        "q_fresh": float(largest[1].mean()),
        "target_running": float(targets.amax(1).mean()),
        "target_fresh": float(fresh_targets.amax(1).mean()),
        **{f"off_{name}": value for name, value in _distances(running, fresh, task).items()},
    }


def _distances(running: QNetwork, fresh: QNetwork, task: int) -> dict[str, float]:
    """Median over a layer's channels of |running mean - fresh mean| / fresh standard deviation."""
    found = {}
    theirs = dict(fresh.named_modules())
    for name, layer in running.named_modules():
        if isinstance(layer, TaskBatchNorm):
            mean_C, (fresh_mean_C, fresh_var_C) = layer.statistics(task)[0], theirs[name].statistics(task)
            off_C = (mean_C - fresh_mean_C).abs() / fresh_var_C.sqrt().clamp_min(1e-6)
            found[name.split(".")[1]] = float(off_C.median())
    return found


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder with a checkpoint and its replay")
    parser.add_argument("--out", type=Path, metavar="FILE.csv", help="write here; the default is the terminal")
    arguments = parser.parse_args()
    write_rows(list(rows(arguments.run)), arguments.out)


if __name__ == "__main__":
    main()
