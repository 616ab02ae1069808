"""The eager engine: PyTorch, operation by operation. It runs everywhere; the others are tested against it."""

from __future__ import annotations

import torch
from torch import Tensor

from switchmt_snn.config import ExperimentConfig, LearningConfig
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.updates.passes import DifferentiatedPass, forward_passes
from switchmt_snn.updates.protocol import Engine, Values


class Eager(Engine):
    """Operation by operation."""

    name = "eager"
    needs = "any run"
    torchrun = True

    def __init__(self, network: QNetwork, target: QNetwork, config: LearningConfig) -> None:
        super().__init__(network, target, config)
        differentiated = DifferentiatedPass(network, self.precision)
        self._passes = forward_passes(network, target, differentiated, self.precision, config)

    @classmethod
    def pays(cls, config: ExperimentConfig, device: torch.device, precision: str) -> bool:
        """Always: it is what ``auto`` takes last."""
        return True

    def values(self, observations: Tensor, next_observations: Tensor, task: int, generator: torch.Generator) -> Values:
        """See ``Engine.values``."""
        return self._passes(observations, next_observations, task, generator)
