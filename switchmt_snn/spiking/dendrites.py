"""Active dendrites: task context -> gain of each neuron's input current (paper, Eq. 1).

Shapes: K tasks, S dendritic segments, N neurons.

Eq. 1 adds ``f(sum_i s_i(t), max_j d_j^T c)`` to the membrane, with c the one-hot task. The released script's f is
``f(I, d) = I * sigmoid(d)``; so for task k the gain is ``sigmoid(max_j d_jk)``, a constant in [0, 1] per neuron.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from switchmt_snn.config import NetworkConfig
from switchmt_snn.spiking.settings import require_known


class ActiveDendrites(nn.Module):
    """Gain of each neuron for a task.

    ``shared``: one set of S segments for all N neurons, S x K weights (the paper's 18 for two streams, S = K = 3).
    ``per_neuron``: own segments, N x S x K weights (Iyer et al. 2022, arXiv 2201.00042).
    """

    tasks_K: Tensor

    def __init__(self, config: NetworkConfig, num_neurons: int, num_tasks: int) -> None:
        """Draw the segments from N(0, 1), as the released script does."""
        super().__init__()
        require_known("dendritic_gating", config.dendritic_gating, ("max", "absolute_max"))
        rows = num_neurons if config.dendrites == "per_neuron" else 1
        self.segments_NSK = nn.Parameter(torch.randn(rows, config.dendritic_segments, num_tasks))
        self.register_buffer("tasks_K", torch.arange(num_tasks), persistent=False)
        self.gating = config.dendritic_gating

    def forward(self, task: int) -> Tensor:
        """Return the gains for a task: ``[N]`` (per_neuron) or ``[1]`` (shared), each within (0, 1)."""
        return self.gains(self.index(task))

    def index(self, task: int) -> Tensor:
        """The task as a tensor ``[1]``."""
        return self.tasks_K[task : task + 1]

    def gains(self, task_1: Tensor) -> Tensor:
        """As ``forward``, with the task as a tensor: code that is compiled once serves every task."""
        responses_NS = self.segments_NSK.index_select(2, task_1).squeeze(2)
        if self.gating == "max":
            chosen_N = responses_NS.amax(dim=1)
        else:
            index_N1 = responses_NS.abs().argmax(dim=1, keepdim=True)
            chosen_N = responses_NS.gather(1, index_N1).squeeze(1)
        return torch.sigmoid(chosen_N)


def make_dendrites(config: NetworkConfig, num_neurons: int, num_tasks: int) -> ActiveDendrites | None:
    """The dendrites that ``config.dendrites`` names; None for ``none``.

    Raises:
        ConfigError: another value, ``auto`` included.
    """
    known = ("none", "shared", "per_neuron")
    require_known("dendrites", config.dendrites, known, "switchmt_snn.config.resolve replaces auto")
    return None if config.dendrites == "none" else ActiveDendrites(config, num_neurons, num_tasks)


def keep_k_winners(current: Tensor, k: int) -> Tensor:
    """Zero all but the k largest input currents of ``[T, B, N]`` at each step (Iyer et al. 2022: k-winner-take-all).

    Of equal currents the one with the lower index wins, as in ONNX; ``torch.topk`` leaves that open.
    """
    if k >= current.shape[-1]:
        return current
    winners = current.sort(dim=-1, descending=True, stable=True).indices[..., :k]
    mask = torch.zeros_like(current).scatter_(-1, winners, 1.0)
    return current * mask
