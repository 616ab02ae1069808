"""Batch normalisation whose running statistics may be kept per task.

A minibatch of Algorithm 1 comes from one task, so statistics shared by all tasks describe whichever task was trained
last (docs/algorithm.md, deviation 6). Affine weights are shared always, so the parameter count does not change.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ConfigError


class TaskBatchNorm(nn.Module):
    """BatchNorm over ``[B, C, ...]`` with running mean and variance for each task (rows of ``[K, C]`` buffers).

    When T simulation steps are folded into the batch (``[T*B, C, ...]``), statistics are pooled over time and batch.
    """

    running_mean_KC: Tensor
    running_var_KC: Tensor

    def __init__(self, num_channels: int, num_tasks: int, per_task: bool, momentum: float, epsilon: float = 1e-5):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(num_channels))
        self.bias = nn.Parameter(torch.zeros(num_channels))
        rows = num_tasks if per_task else 1
        self.register_buffer("running_mean_KC", torch.zeros(rows, num_channels))
        self.register_buffer("running_var_KC", torch.ones(rows, num_channels))
        self.momentum = momentum
        self.epsilon = epsilon

    def forward(self, x: Tensor, task: int) -> Tensor:
        """Normalise by the batch in training mode (and move the task's running statistics), by the task's running
        statistics in eval mode."""
        return self.normalize(x, self.statistics(task), self.training)

    def normalize(self, x: Tensor, statistics: tuple[Tensor, ...], training: bool) -> Tensor:
        """As ``forward``, with a task's running mean and variance ``[C]`` and the mode handed in."""
        mean_C, var_C = statistics
        return F.batch_norm(x, mean_C, var_C, self.weight, self.bias, training, self.momentum, self.epsilon)

    @torch.no_grad()
    def move(self, statistics: tuple[Tensor, ...], batch_mean_C: Tensor, batch_var_C: Tensor, count: int) -> None:
        """Move running statistics ``[C]`` towards those of a batch of ``count`` values per channel.

        ``batch_var_C`` is the biased variance; the running one is unbiased, as in F.batch_norm.
        """
        mean_C, var_C = statistics
        mean_C.lerp_(batch_mean_C, self.momentum)
        var_C.lerp_(batch_var_C * (count / (count - 1)), self.momentum)

    def statistics(self, task: int) -> tuple[Tensor, Tensor]:
        """Running mean and variance ``[C]`` that eval mode uses for a task (views of the buffers)."""
        row = task if self.running_mean_KC.shape[0] > 1 else 0
        return self.running_mean_KC[row], self.running_var_KC[row]


class FixedBatchNorm(TaskBatchNorm):
    """BatchNorm whose weight and bias are one constant, not parameters: ``(y - mean) / std * value + value``.

    With half the threshold as value, a neuron's current has half the threshold as mean and as standard deviation over a
    batch, so a current above the threshold is one standard deviation away. CaRe-BN (ICLR 2026) does so in spiking
    Q-networks.
    """

    def __init__(self, num_channels: int, num_tasks: int, per_task: bool, momentum: float, value: float) -> None:
        super().__init__(num_channels, num_tasks, per_task, momentum)
        del self.weight, self.bias
        self.register_buffer("weight", torch.full((num_channels,), value), persistent=False)
        self.register_buffer("bias", torch.full((num_channels,), value), persistent=False)


def make_mlp_normalization(config: NetworkConfig, num_neurons: int, num_tasks: int) -> TaskBatchNorm | None:
    """The normalization of the ``mlp`` trunk's currents that ``config.mlp_normalization`` names.

    Raises:
        ConfigError: unknown name.
    """
    if config.mlp_normalization == "none":
        return None
    if config.mlp_normalization == "batch":
        return TaskBatchNorm(num_neurons, num_tasks, config.normalization == "per_task", config.normalization_momentum)
    raise ConfigError(f"network.mlp_normalization is {config.mlp_normalization!r}, expected none or batch")


def make_stream_normalization(config: NetworkConfig, num_neurons: int, num_tasks: int) -> FixedBatchNorm | None:
    """The normalization of a stream's currents that ``config.stream_normalization`` names.

    Raises:
        ConfigError: unknown name.
    """
    if config.stream_normalization == "none":
        return None
    if config.stream_normalization == "batch":
        per_task, value = config.normalization == "per_task", config.threshold * config.stream_current_thresholds
        return FixedBatchNorm(num_neurons, num_tasks, per_task, config.normalization_momentum, value)
    raise ConfigError(f"network.stream_normalization is {config.stream_normalization!r}, expected none or batch")
