"""The graph engine: a learner's whole update as one CUDA graph.

One call launches forward passes, target, backward, clipping, Adam and the sums of metrics, so the host does not launch
some hundred kernels one by one. A graph is captured for every task, because each task's running statistics and gains
have addresses of their own. An update must not read a number back to the host (a test watches that), and every tensor
that it changes must keep its address.
"""

from __future__ import annotations

import torch
from torch import Tensor

from switchmt_snn.config import ExperimentConfig, LearningConfig
from switchmt_snn.errors import TrainingFailed
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.updates.compiled import compile_whole
from switchmt_snn.updates.passes import DifferentiatedPass, forward_passes
from switchmt_snn.updates.protocol import DeviceBatch, Engine, Step, Values, adam

WARMUP_UPDATES = 3
"""Updates before the first capture: compilation, autotuning and the optimizer's state come with them."""


class CudaGraph(Engine):
    """Compiled by torch.compile and captured as a CUDA graph."""

    name = "graph"
    needs = "a run on a CUDA device"

    def __init__(self, network: QNetwork, target: QNetwork, config: LearningConfig) -> None:
        super().__init__(network, target, config)
        differentiated = DifferentiatedPass(network, self.precision)
        self._passes = forward_passes(network, target, differentiated, self.precision, config, compile_whole)

    @classmethod
    def unavailable(cls, config: ExperimentConfig, device: torch.device, processes: int = 1) -> str | None:
        """See ``Engine.unavailable``."""
        if device.type != "cuda":
            return f"this one is on device {device.type}"
        if config.learning.learning_rate_decay_updates is not None:
            return "a captured update keeps its learning rate, and learning.learning_rate_decay_updates changes it"
        return super().unavailable(config, device, processes)

    @classmethod
    def status(cls) -> str:
        """See ``Engine.status``."""
        return "works" if torch.cuda.is_available() else "no CUDA device"

    def values(self, observations: Tensor, next_observations: Tensor, task: int, generator: torch.Generator) -> Values:
        """See ``Engine.values``."""
        return self._passes(observations, next_observations, task, generator)

    def optimizer(self) -> torch.optim.Optimizer:
        """Adam whose step can be captured."""
        return adam(self.network, self.config, capturable=True)

    def executed(self, step: Step, optimizer: torch.optim.Optimizer, generator: torch.Generator) -> Step:
        """See ``Engine.executed``."""
        return GraphedStep(step, optimizer, generator)


class GraphedStep:
    """A step that is captured once per task and then replayed; its batches must have one shape."""

    def __init__(self, step: Step, optimizer: torch.optim.Optimizer, generator: torch.Generator) -> None:
        """Prepare; nothing is captured yet.

        Args:
            step: changes tensors in place only, and never waits for the device.
            optimizer: its gradients are set to None before a capture, so that they are made in the graph's memory.
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
        # Other threads may send frames meanwhile; their calls must not end this capture.
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
