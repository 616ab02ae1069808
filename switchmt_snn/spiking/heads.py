"""The last linear layer of a stream: outputs that all tasks share, or outputs of its own for each task.

Shapes: K tasks, O outputs of a task (all quantiles of them), N hidden neurons.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from switchmt_snn.config import NetworkConfig
from switchmt_snn.spiking.settings import require_known


class TaskHeads(nn.Linear):
    """A linear head for each task: ``y = W_k x + b_k``. The rows of all tasks are one weight ``[K * O, N]``.

    Rows of other tasks get no gradient; Adam still moves them for some updates by the gradients that it remembers.
    """

    tasks_K: Tensor

    def __init__(self, num_features: int, num_outputs: int, num_tasks: int) -> None:
        """``num_outputs`` are those of one task."""
        super().__init__(num_features, num_tasks * num_outputs)
        self.register_buffer("tasks_K", torch.arange(num_tasks), persistent=False)

    def index(self, task: int) -> Tensor:
        """The task as a tensor ``[1]``: code that is compiled once serves every task."""
        return self.tasks_K[task : task + 1]

    def of_task(self, x: Tensor, task_1: Tensor) -> Tensor:
        """Outputs ``[..., O]`` of a task, as ``index`` names it, for ``x`` ``[..., N]``."""
        weight_ON, bias_O = (
            part.unflatten(0, (len(self.tasks_K), -1)).index_select(0, task_1).squeeze(0)
            for part in (self.weight, self.bias)
        )
        return F.linear(x, weight_ON, bias_O)


def make_head(config: NetworkConfig, num_features: int, num_outputs: int, num_tasks: int) -> nn.Linear:
    """The head that ``config.heads`` names, with ``num_outputs`` per task.

    Raises:
        ConfigError: unknown name.
    """
    require_known("heads", config.heads, ("shared", "per_task"))
    if config.heads == "shared":
        return nn.Linear(num_features, num_outputs)
    return TaskHeads(num_features, num_outputs, num_tasks)
