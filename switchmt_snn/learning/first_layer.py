"""The first layer's running means, computed from the mean input of each task.

An image's background is a large constant input, so one Adam step moves the mean of a first-layer current by a good part
of its spread. A running mean of currents then belongs to older weights, and the network that acts is another one than
the one that learns. But the layer is linear: its mean current is its weights times the mean input, which does not
depend on weights at all (results/recipe, First layer).
"""

from __future__ import annotations

from typing import Any, ClassVar, cast

import torch
from torch import Tensor

from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.state import Stateful, tensors_like
from switchmt_snn.spiking.network import QNetwork, TrunkLayer
from switchmt_snn.spiking.normalization import TaskBatchNorm


class FirstLayerMeans(Stateful):
    """Keeps ``running_mean_KC`` of a network's first BatchNorm at the mean currents of the present weights.

    Attributes:
        inputs: running mean input of each task, ``[C, h, w]`` or ``[C]``, with BatchNorm's momentum.
        batches: batches seen of each task.
    """

    SAVED: ClassVar[tuple[str, ...]] = ("inputs", "batches")
    DERIVED: ClassVar[tuple[str, ...]] = ("_layer", "_network")

    def __init__(self, network: QNetwork) -> None:
        """The network has direct encoding, and statistics per task.

        Raises:
            ConfigError: its first layer has no BatchNorm.
        """
        self._network = network
        self._layer = cast(TrunkLayer, next(iter(network.trunk.values())))
        if self._layer.normalization is None:
            raise ConfigError(
                "learning.first_layer_mean is input, expected running for a first layer without BatchNorm; or set "
                "network.mlp_normalization=batch"
            )
        tasks, shape = network.observation.num_tasks, network.observation.shape
        device = next(network.parameters()).device
        self.inputs = [torch.zeros(shape, device=device) for _ in range(tasks)]
        self.batches = [0] * tasks

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put a saved state back, on the network's device.

        Raises:
            CheckpointError: it is not whole, or of other tasks or observations.
        """
        inputs = self.inputs
        super().load_state_dict(state)
        self.inputs = tensors_like(inputs, self.inputs, f"inputs of {type(self).__name__}")

    @torch.no_grad()
    def follow(self, observations: Tensor, task: int) -> None:
        """After an update: take its raw observations ``[B, *shape]`` into the task's mean, and set all tasks' means."""
        normalization = cast(TaskBatchNorm, self._layer.normalization)
        mean = self._network.encode(observations.to(torch.float32).mean(0, keepdim=True))[0, 0]
        self.inputs[task].lerp_(mean, normalization.momentum if self.batches[task] else 1.0)
        self.batches[task] += 1
        running_KC = normalization.running_mean_KC
        means_KC = self._layer.synapses(torch.stack(self.inputs)).reshape(*running_KC.shape, -1).mean(2)
        for other, batches in enumerate(self.batches):
            if batches:
                running_KC[other].copy_(means_KC[other])
