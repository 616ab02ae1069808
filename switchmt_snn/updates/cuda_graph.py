"""A learner's whole update as one CUDA graph: forward passes, target, backward, clipping, Adam and the sums of metrics
are launched by one call, so the host's time for some hundred kernels is no part of an update.

A graph is captured for every task, because a task's running statistics and gains lie at addresses of their own. Nothing
in an update reads a number back to the host (a test watches that), and everything that it changes stays where it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from switchmt_snn.errors import TrainingFailed

WARMUP_UPDATES = 3
"""Updates before the first capture: compilation, autotuning and the optimiser's state come with them."""


class DeviceBatch(NamedTuple):
    """A batch of one task on the learner's device."""

    observations: Tensor
    """``[B, *shape]``, raw."""
    actions_B: Tensor
    rewards_B: Tensor
    next_observations: Tensor
    terminated_B: Tensor


Step = Callable[[DeviceBatch, int], None]
"""An update on a batch of a task."""


class GraphedStep:
    """A step that is captured once per task and then replayed; its batches must have one shape."""

    def __init__(self, step: Step, optimizer: torch.optim.Optimizer, generator: torch.Generator) -> None:
        """Prepare; nothing is captured yet.

        Args:
            step: changes tensors in place only, and never waits for the device.
            optimizer: its gradients are set to None before a capture, so that they lie in the graph's memory.
            generator: whose random numbers the step draws.
        """
        self._step, self._optimizer, self._generator = step, optimizer, generator
        self._graphs: dict[int, torch.cuda.CUDAGraph] = {}
        self._batch: DeviceBatch | None = None
        self._updates = 0
        self._stream = torch.cuda.Stream()
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, batch: DeviceBatch, task: int) -> None:
        """One update."""
        if self._batch is None:
            self._batch = DeviceBatch(*(tensor.clone() for tensor in batch))
        for kept, tensor in zip(self._batch, batch, strict=True):
            kept.copy_(tensor, non_blocking=True)
        self._updates += 1
        if self._updates <= WARMUP_UPDATES:
            current = torch.cuda.current_stream()
            self._stream.wait_stream(current)
            with torch.cuda.stream(self._stream):
                self._step(self._batch, task)
            current.wait_stream(self._stream)
            return
        if task not in self._graphs:
            self._graphs[task] = self._capture(self._batch, task)
        self._graphs[task].replay()

    def _capture(self, batch: DeviceBatch, task: int) -> torch.cuda.CUDAGraph:
        self._optimizer.zero_grad(set_to_none=True)
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self._generator)
        # Other threads may send frames meanwhile: what they call is no concern of this capture.
        try:
            with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
                self._step(batch, task)
        except torch.cuda.OutOfMemoryError:
            raise
        except RuntimeError as error:
            raise TrainingFailed(
                f"an update cannot be captured as a CUDA graph ({str(error).splitlines()[0]}), expected one on this "
                "device; start another run (--run OTHER --learning.engine compiled)"
            ) from error
        return graph
