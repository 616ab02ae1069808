"""The neuron of the ANN methods: ``S = max(I, 0)``; no time, no state."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from switchmt_snn.spiking.layers import NeuronNode
from switchmt_snn.spiking.neurons.base import NeuronLayer, NeuronState


@dataclass(frozen=True)
class ReLUNode(NeuronNode):
    """Rectified linear units; they have no parameters."""

    @property
    def kind(self) -> str:
        """``relu``."""
        return "relu"

    @property
    def states(self) -> tuple[str, ...]:
        """None."""
        return ReLULayer.STATE


class ReLULayer(NeuronLayer):
    """Activations ``max(I, 0)``."""

    ENGINES = ("fused", "snntorch")

    def step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """``max(I, 0)`` of currents ``[B, ...]``, and the empty state."""
        return torch.relu(current_t), state

    def node(self, channels: int) -> ReLUNode:
        """See ``ReLUNode``."""
        return ReLUNode()

    def run(self, current: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """All T steps at once."""
        return torch.relu(current), state
