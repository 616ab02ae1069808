"""A stored run as it was at its newest checkpoint, replay included, for measurements on it."""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from switchmt_snn.learning.training import Training
from switchmt_snn.replay.ring import Returns
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.plan import plan
from switchmt_snn.spiking.network import QNetwork


@contextmanager
def restored(run: Path) -> Iterator[Training]:
    """The run's training, ready to go on; closed at the end."""
    folder = RunFolder(run)
    config = folder.config()
    planned = plan(config, config)
    training = Training(planned.config, planned.suite, planned.device)
    training.load_state_dict(folder.checkpoints().load(training.replays).state)
    try:
        yield training
    finally:
        training.close()


def tasks_learned(training: Training) -> Iterator[tuple[int, str]]:
    """Index and name of each task whose replay is sampled by now."""
    for task, name in enumerate(training.suite.names):
        if not training.is_warming_up(task):
            yield task, name


def drawn(training: Training, task: int, batches: int, batch_size: int, seed: int) -> list[Tensor]:
    """Batches of raw observations of a task's replay; the same seed draws the same."""
    rng, replay = np.random.default_rng(seed), training.replays[task]
    return [torch.as_tensor(replay.sample(batch_size, rng, Returns()).observations) for _ in range(batches)]


@torch.no_grad()
def q_values(network: QNetwork, batches: list[Tensor], task: int, precision: torch.dtype | None = None) -> Tensor:
    """Q-values ``[B, A]`` of all batches, as the network stands, on the CPU."""
    device = next(network.parameters()).device
    return torch.cat([network(x.to(device), task, precision=precision).float().cpu() for x in batches])


def write_rows(found: Sequence[dict[str, Any]], out: Path | None) -> None:
    """Rows as CSV, numbers with four digits after the point; to the terminal if there is no file."""
    with out.open("w", newline="") if out else sys.stdout as stream:
        writer = csv.DictWriter(stream, list(found[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {key: f"{value:.4f}" if isinstance(value, float) else value for key, value in row.items()} for row in found
        )
