"""Readouts: Q-values from the outputs of a head over time.

Shapes: T simulation steps, B batch, N hidden neurons, A actions, O outputs of a head.

A head is linear: ``y(t) = W s(t) + b`` for the hidden spikes s(t). The membrane readouts integrate its outputs in
neurons that never fire: ``M(t) = beta M(t-1) + y(t)``, ``M(0) = 0``.

| name | Q |
|---|---|
| mean | mean over t of y(t), computed as y of the mean spikes |
| last_membrane | M(T) |
| max_membrane | largest M(t) |
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.spiking.settings import require_known


class Readout:
    """What a stream's head does with the hidden spikes, and what becomes of the streams' combined outputs.

    Attributes:
        keeps_streams: whether ``stream`` gives ``[B, O]``, so that a dueling network has one value per decision.
    """

    keeps_streams = True

    def __init__(self, beta: float) -> None:
        """``beta`` is the decay of M per simulation step."""
        self.beta = beta

    def stream(self, head: Callable[[Tensor], Tensor], spikes_TBN: Tensor) -> Tensor:
        """Outputs of one stream, ``[B, O]`` or ``[T, B, O]``, for its hidden spikes."""
        return self.integrate(head(spikes_TBN))

    def integrate(self, outputs_TBO: Tensor) -> Tensor:
        """As ``stream``, from the head's output at every step."""
        raise NotImplementedError(f"{type(self).__name__} defines no integrate, expected its equation")

    def q_values(self, combined: Tensor) -> Tensor:
        """Q ``[B, A]`` from the streams' outputs, combined: ``[B, A]`` or ``[T, B, A]``."""
        return combined


class Mean(Readout):
    """Mean over T. The head is linear, so it is applied once, to the mean spikes."""

    def stream(self, head: Callable[[Tensor], Tensor], spikes_TBN: Tensor) -> Tensor:
        """``[B, O]``."""
        return head(spikes_TBN.mean(0))

    def integrate(self, outputs_TBO: Tensor) -> Tensor:
        """``[B, O]``."""
        return outputs_TBO.mean(0)


class LastMembrane(Readout):
    """Membrane after the last step."""

    def integrate(self, outputs_TBO: Tensor) -> Tensor:
        """``[B, O]``."""
        return membranes(outputs_TBO, self.beta)[-1]


class MaxMembrane(Readout):
    """Largest membrane; of a dueling network the largest combined one."""

    keeps_streams = False

    def integrate(self, outputs_TBO: Tensor) -> Tensor:
        """``[T, B, O]``."""
        return torch.stack(membranes(outputs_TBO, self.beta))

    def q_values(self, combined: Tensor) -> Tensor:
        """The largest over T."""
        return combined.amax(0)


READOUTS: dict[str, type[Readout]] = {
    "mean": Mean,
    "last_membrane": LastMembrane,
    "max_membrane": MaxMembrane,
}
"""Readouts by the name that ``network.readout`` takes."""


def membranes(outputs_TBO: Tensor, beta: float) -> list[Tensor]:
    """M(1) ... M(T), each ``[B, O]``."""
    trace = [outputs_TBO[0]]
    for output_BO in outputs_TBO[1:]:
        trace.append(beta * trace[-1] + output_BO)
    return trace


def make_readout(config: NetworkConfig) -> Readout:
    """The readout that ``config.readout`` names.

    Raises:
        ConfigError: no such readout.
    """
    require_known("readout", config.readout, READOUTS)
    return READOUTS[config.readout](config.readout_beta)
