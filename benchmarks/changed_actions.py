"""How many decisions of a stored run change when its weights change a little.

``python -m benchmarks.changed_actions RUN ... [--out FILE.csv]``, for runs with a checkpoint and its replay. The
network that learns decides on 512 observations of each task's replay; then again after one change, with BatchNorm
statistics re-estimated for it:

- ``weights E``: Gaussian noise on every weight, E times the root mean square of its tensor, three draws;
- ``bfloat16``: products with both factors rounded to bfloat16, as updates in that precision compute them;
- ``updates N``: N rounds of the run's own updates of all tasks, from the replay.

Written: the share of observations whose greedy action is another one; how far advantages (Q minus its mean over the
actions) moved, as a share of their own spread over actions; the correlation of the advantages.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.restored import drawn, q_values, restored, tasks_learned, write_rows
from switchmt_snn.config.experiment import clips_rewards
from switchmt_snn.learning.statistics import reestimate_statistics
from switchmt_snn.learning.training import Training
from switchmt_snn.replay.ring import Returns
from switchmt_snn.spiking.network import QNetwork

NOISE = (1e-5, 1e-4, 1e-3, 1e-2)
DRAWS = 3
ROUNDS = (1, 10)
BATCHES, BATCH_SIZE, SEED = 8, 64, 0


def rows(run: Path) -> Iterator[dict[str, Any]]:
    """One row for each task of a run's newest checkpoint and each change."""
    with restored(run) as training:
        learner, tasks = training.learner, list(tasks_learned(training))
        seen = {task: drawn(training, task, 2 * BATCHES, BATCH_SIZE, SEED) for task, _ in tasks}
        before = {task: _decided(learner.network, seen[task], task) for task, _ in tasks}

        def compared(change: str, network: QNetwork, precision: torch.dtype | None = None) -> Iterator[dict[str, Any]]:
            for task, name in tasks:
                valid = torch.from_numpy(training.suite.valid_actions_KA[task])
                after = _decided(network, seen[task], task, precision)
                facts = {"run": run.name, "method": training.config.network.method, "step": training.steps}
                yield {**facts, "task": name, "change": change, **_change(before[task][:, valid], after[:, valid])}

        yield from compared("bfloat16", learner.network, torch.bfloat16)
        for size in NOISE:
            for draw in range(DRAWS):
                yield from compared(f"weights {size:g}", _noisy(learner.network, size, draw))
        for rounds in ROUNDS:
            state = copy.deepcopy(learner.state_dict())
            _learn(training, rounds)
            yield from compared(f"updates {rounds}", learner.network)
            learner.load_state_dict(state)


def _decided(network: QNetwork, seen: list[Tensor], task: int, precision: torch.dtype | None = None) -> Tensor:
    """Q-values of the second half of the batches, with statistics of the first half."""
    fresh, device = copy.deepcopy(network).eval(), next(network.parameters()).device
    reestimate_statistics(fresh, task, (x.to(device) for x in seen[:BATCHES]), torch.Generator(device))
    return q_values(fresh, seen[BATCHES:], task, precision)


def _noisy(network: QNetwork, size: float, draw: int) -> QNetwork:
    """A copy with noise on weights; biases, BatchNorm's gains and shifts stay."""
    noisy, generator = copy.deepcopy(network), torch.Generator().manual_seed(draw)
    with torch.no_grad():
        for parameter in noisy.parameters():
            if parameter.dim() > 1:
                noise = torch.randn(parameter.shape, generator=generator).to(parameter.device)
                parameter += size * parameter.square().mean().sqrt() * noise
    return noisy


def _learn(training: Training, rounds: int) -> None:
    learning = training.config.learning
    returns = Returns(learning.n_steps, learning.discount, clips_rewards(training.config))
    for _ in range(rounds * learning.updates_per_round):
        for task, _ in tasks_learned(training):
            batch = training.replays[task].sample(learning.batch_size, training.sample_rng, returns)
            training.learner.update(batch, task)


def _change(before_BA: Tensor, after_BA: Tensor) -> dict[str, float]:
    ours, theirs = (q_BA - q_BA.mean(1, keepdim=True) for q_BA in (before_BA, after_BA))
    return {
        "changed_actions": float((before_BA.argmax(1) != after_BA.argmax(1)).float().mean()),
        "advantage_change": float((theirs - ours).square().mean().sqrt() / ours.square().mean().sqrt()),
        "advantage_correlation": float(torch.corrcoef(torch.stack([ours.flatten(), theirs.flatten()]))[0, 1]),
    }


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folder with a checkpoint and its replay")
    parser.add_argument("--out", type=Path, metavar="FILE.csv", help="write here; the default is the terminal")
    arguments = parser.parse_args()
    write_rows([row for run in arguments.runs for row in rows(run)], arguments.out)


if __name__ == "__main__":
    main()
