"""Synaptic: a leaky neuron whose input passes through a decaying synaptic current (``snntorch.Synaptic``).

Per step (snnTorch 1.0; strict ``>``; H the Heaviside step, theta the threshold, x(t) the input)::

    R(t) = H(U(t-1) - theta)                               the reset owed by the last spike; no gradient
    I(t) = alpha I(t-1) + x(t)                             the synaptic current
    V(t) = beta U(t-1) + I(t)
    zero:      U(t) = (1 - R(t)) V(t)
    subtract:  U(t) = V(t) - R(t) theta
    S(t) = H(U(t) - theta)                                 gradient: the surrogate

A reset to zero differs from that of IF and LIF: as in snnTorch, the membrane is zero *after* the input of the step that
follows a spike, so that input reaches the membrane only through later synaptic currents. No reset touches I.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import snntorch
import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.spiking.layers import Array, NeuronNode
from switchmt_snn.spiking.neurons.base import NeuronLayer, NeuronState, over_time, unlisted


@dataclass(frozen=True)
class SynapticNode(NeuronNode):
    """Current-based leaky neurons.

    Attributes:
        alpha_O: decay of the synaptic current per simulation step.
        beta_O: decay of the membrane per simulation step.
        threshold_O: a neuron fires when its membrane is strictly above it.
        reset: ``zero`` (after the input) or ``subtract``.
    """

    alpha_O: Array
    beta_O: Array
    threshold_O: Array
    reset: str

    @property
    def kind(self) -> str:
        """``Synaptic``."""
        return "Synaptic"

    @property
    def states(self) -> tuple[str, ...]:
        """The synaptic current and the membrane."""
        return SynapticLayer.STATE


class SynapticLayer(NeuronLayer):
    """Current-based leaky neurons over T steps.

    Attributes:
        synaptic: the snnTorch neuron, which holds alpha, beta and threshold. Its own state is never used.
    """

    STATE = ("current", "membrane")
    ENGINES = ("fused", "snntorch")

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        neuron = snntorch.Synaptic(
            alpha=config.alpha,
            beta=config.beta,
            threshold=config.threshold,
            spike_grad=self.surrogate,
            learn_beta=config.learn_beta,
            learn_threshold=config.learn_threshold,
            reset_mechanism=config.reset,
            reset_delay=True,
        )
        self.synaptic = unlisted(neuron)
        self.reset = config.reset
        self.by_snntorch = config.neuron_engine == "snntorch"

    def step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """The module's equations: bitwise the values of ``snntorch.Synaptic``."""
        synaptic, membrane = state
        alpha, beta, threshold = self.synaptic.alpha, self.synaptic.beta.clamp(0, 1), self.synaptic.threshold
        fired = (membrane > threshold).to(current_t.dtype)
        synaptic = alpha * synaptic + current_t
        membrane = beta * membrane + synaptic
        membrane = membrane - fired * (membrane if self.reset == "zero" else threshold)
        return self.surrogate(membrane - threshold), (synaptic, membrane)

    def node(self, channels: int) -> SynapticNode:
        """See ``SynapticNode``."""
        alpha, beta, threshold = (
            np.full(channels, float(value.detach()))
            for value in (self.synaptic.alpha, self.synaptic.beta.clamp(0, 1), self.synaptic.threshold)
        )
        return SynapticNode(alpha, beta, threshold, self.reset)

    def run(self, current: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """T steps of the equations, or of snnTorch's neuron."""
        if not self.by_snntorch:
            return over_time(self.step, current, state)
        spikes, state = over_time(self._snntorch_step, current, state)
        nothing = torch.zeros(0, device=current.device)
        self.synaptic.syn, self.synaptic.mem = nothing, nothing
        return spikes, state

    def _snntorch_step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        spikes_t, *after = self.synaptic(current_t, *state)
        return spikes_t, tuple(after)
