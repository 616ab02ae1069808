"""Updates that several processes under ``torchrun`` divide: how they talk, and the engine that averages their parts.

The first process runs the whole of Algorithm 1 (``SharedLearner``). For
every update it deals its batch out in equal parts. Each process computes its part's gradient,
``DistributedDataParallel`` averages them, BatchNorm sums its statistics over all processes, and every process takes the
same Adam step. So the run is that of one process, to rounding. Random encodings are the exception: every process draws
its own spikes.
"""

from __future__ import annotations

import gc
import os
import signal
import warnings
from collections.abc import Callable
from dataclasses import fields
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from switchmt_snn.config import LearningConfig
from switchmt_snn.machine.devices import select_device
from switchmt_snn.replay.ring import Batch
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.spiking.normalization import TaskBatchNorm
from switchmt_snn.updates.passes import DifferentiatedPass, forward_passes
from switchmt_snn.updates.protocol import Engine, Values

STOP, UPDATE, COPY_TARGET, LOAD, SCALE = range(5)
"""What the first process announces."""


class _SumOverProcesses(torch.autograd.Function):
    """The sum of all processes' tensors; its gradient is the sum of all processes' gradients."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        total = x.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        total = gradients[0].clone()
        dist.all_reduce(total)
        return total


class ProcessGroup:
    """The processes that ``torchrun`` started.

    Attributes:
        rank: this process's number; 0 is the one that plays.
        size: number of processes.
    """

    def __init__(self) -> None:
        """Join the others (gloo for tensors on the CPU, NCCL for tensors on GPUs)."""
        backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
        dist.init_process_group(backend, timeout=timedelta(days=7))  # the first process may evaluate for hours
        self.rank, self.size = dist.get_rank(), dist.get_world_size()

    def device(self, name: str) -> torch.device:
        """A requested device as this process's own: one GPU for each process of a machine."""
        device = select_device(name)
        return torch.device(device.type, int(os.environ["LOCAL_RANK"])) if device.type == "cuda" else device

    def sum(self, x: Tensor) -> Tensor:
        """The sum of all processes' ``x``, differentiable; every process must call it."""
        total: Tensor = _SumOverProcesses.apply(x)  # type: ignore[no-untyped-call, unused-ignore]
        return total

    def announce(self, what: int, task: int = 0) -> None:
        """First process: tell the others what comes next."""
        dist.broadcast(torch.tensor([what, task]), 0)

    def heard(self) -> tuple[int, int]:
        """Other processes: what comes next, and for which task."""
        message = torch.zeros(2, dtype=torch.int64)
        dist.broadcast(message, 0)
        what, task = message.tolist()
        return what, task

    def deal(self, batch: Batch) -> Batch:
        """First process: deal a batch out; returns its own part."""
        return self._dealt({field.name: getattr(batch, field.name) for field in fields(Batch)})

    def dealt(self, like: Batch) -> Batch:
        """Other processes: the part dealt to this one; ``like`` has its shapes and dtypes."""
        return self._dealt({field.name: getattr(like, field.name) for field in fields(Batch)})

    def _dealt(self, arrays: dict[str, Any]) -> Batch:
        parts: dict[str, Any] = {}
        for name, array in arrays.items():
            tensor = torch.from_numpy(array)
            sent = tensor.view(torch.uint8) if tensor.dtype == torch.bool else tensor
            chunks = [chunk.contiguous() for chunk in sent.chunk(self.size)] if self.rank == 0 else None
            part = torch.empty_like(chunks[0] if chunks else sent)
            dist.scatter(part, chunks, 0)
            parts[name] = part.view(tensor.dtype).numpy()
        return Batch(**parts)

    def share(self, value: Any = None) -> Any:
        """The first process's value, in every process (pickled between them, never to a file)."""
        box = [value]
        dist.broadcast_object_list(box, 0)
        return box[0]

    def leave(self) -> None:
        """Leave the group; everything that refers to it must be dropped before."""
        gc.collect()
        dist.destroy_process_group()


def join_processes() -> ProcessGroup | None:
    """The group that ``torchrun`` started this process in; None for a process of its own.

    Only the first process reacts to Ctrl-C: it saves, and tells the others to stop.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return None
    group = ProcessGroup()
    if group.rank > 0:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return group


class Divided(Engine):
    """The eager engine on one process's part of each batch. Made for a group, so it is not in the registry."""

    name = "eager"
    needs = "processes that torchrun started"
    torchrun = True

    def __init__(self, network: QNetwork, target: QNetwork, config: LearningConfig, group: ProcessGroup) -> None:
        super().__init__(network, target, config)
        self._group = group
        for module in network.modules():
            if isinstance(module, TaskBatchNorm):
                module.normalize = _normalize_over(group, module)  # type: ignore[method-assign]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # torch 2.13 calls it forward_sync_buffers, 2.10 does not
            differentiated = DistributedDataParallel(
                DifferentiatedPass(network, self.precision), broadcast_buffers=False
            )
        self._passes = forward_passes(network, target, differentiated, self.precision, config)

    def values(self, observations: Tensor, next_observations: Tensor, task: int, generator: torch.Generator) -> Values:
        """See ``Engine.values``; of this process's part of a batch."""
        return self._passes(observations, next_observations, task, generator)

    def over_processes(self, mean: Tensor) -> Tensor:
        """See ``Engine.over_processes``."""
        return self._group.sum(mean) / self._group.size


def _normalize_over(group: ProcessGroup, layer: TaskBatchNorm) -> Callable[..., Tensor]:
    """``TaskBatchNorm.normalize`` that in training normalizes by the statistics of all processes' parts of a batch,
    which have one size."""
    alone = layer.normalize

    def normalize(x: Tensor, statistics: tuple[Tensor, ...], training: bool) -> Tensor:
        if not training:
            return alone(x, statistics, training)
        shape = (1, -1, *(1,) * (x.dim() - 2))
        others = [d for d in range(x.dim()) if d != 1]
        count = x.numel() // x.shape[1] * group.size
        batch_mean_C = group.sum(x.sum(others)) / count
        centered = x - batch_mean_C.view(shape)
        batch_var_C = group.sum(centered.square().sum(others)) / count
        layer.move(statistics, batch_mean_C, batch_var_C, count)
        scale_C = layer.weight * (batch_var_C + layer.epsilon).rsqrt()
        return centered * scale_C.view(shape) + layer.bias.view(shape)

    return normalize
