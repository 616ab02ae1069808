"""What every process of test_processes.py runs: updates on given batches; the first process saves the outcome."""

from __future__ import annotations

import sys

import numpy as np
import safetensors.torch
import torch

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.parts import make_learner
from switchmt_snn.learning.shared_learner import SharedLearner
from switchmt_snn.replay.ring import Batch
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.updates.processes import ProcessGroup, join_processes
from tests.conftest import small_config

SIZE = 12


def config() -> ExperimentConfig:
    """A convolution with BatchNorm, dendrites, quantiles and heads per task; gradients are clipped by norm."""
    return small_config(
        tasks={"suite": "minatar", "names": ["breakout", "asterix"]},
        network={
            "trunk": "minatar",
            "hidden_units": 16,
            "timesteps": 3,
            "threshold": 0.5,
            "dendrites": "per_neuron",
            "quantiles": 3,
            "heads": "per_task",
        },
        learning={"batch_size": SIZE, "gradient_clip": "norm", "gradient_clip_at": 0.05, "loss": "huber"},
    )


def batches(size: int = SIZE) -> list[Batch]:
    """Three batches; rewards differ from part to part."""
    rng = np.random.default_rng(3)
    shape = make_suite(config().tasks).observation_shape
    made = []
    for _ in range(3):
        x = rng.integers(0, 2, (2, size, *shape)).astype(np.bool_)
        rewards = np.linspace(-2, 3, size).clip(-1, 1).astype(np.float32)
        made.append(
            Batch(
                x[0], rng.integers(0, 3, size), rewards, x[1], rng.random(size) < 0.3, np.full(size, 0.99, np.float32)
            )
        )
    return made


def outcome(learner: Learner) -> dict[str, torch.Tensor]:
    """Gradients of the first update, then everything after two more and a copy of the target."""
    first, second, third = batches()
    learner.update(first, 0)
    parts = {f"grad/{name}": p.grad.clone() for name, p in learner.network.named_parameters() if p.grad is not None}
    parts |= {f"first/{name}": value.clone() for name, value in learner.network.named_buffers() if "running" in name}
    learner.set_scale(1, 2.5)
    learner.update(second, 1)
    learner.copy_target()
    learner.update(third, 1)
    parts |= {f"network/{name}": value.clone() for name, value in learner.network.state_dict().items()}
    parts |= {f"target/{name}": value.clone() for name, value in learner.target.state_dict().items()}
    return parts | {"loss": learner.loss_sum, "q": learner.q_sum}


def main(path: str) -> None:
    """One process's part."""
    torch.set_num_threads(1)
    group = join_processes()
    assert isinstance(group, ProcessGroup)
    learner = make_learner(config(), make_suite(config().tasks), torch.device("cpu"), group)
    assert isinstance(learner, SharedLearner)
    if group.rank == 0:
        safetensors.torch.save_file(outcome(learner), path)
        learner.close()
    else:
        learner.serve(batches(SIZE // group.size)[0])
    group.leave()


if __name__ == "__main__":
    main(sys.argv[1])
