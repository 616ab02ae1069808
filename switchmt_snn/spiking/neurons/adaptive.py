"""ALIF: a leaky neuron whose threshold rises with its own spikes and decays again (adaptive threshold).

Per step (strict ``>``; H the Heaviside step, theta_0 the threshold at rest)::

    theta(t-1) = theta_0 + strength a(t-1)                 the threshold that the last step was compared with
    R(t) = H(U(t-1) - theta(t-1))                          the last step's spike
    zero:      U(t) = beta (1 - R(t)) U(t-1) + I(t)        R has no gradient here
    subtract:  U(t) = beta U(t-1) + I(t) - R(t) theta(t-1)
    a(t) = decay a(t-1) + R(t)                             R has the surrogate's gradient here
    S(t) = H(U(t) - theta_0 - strength a(t))               gradient: the surrogate

So a spike raises the threshold from the next step on; with ``strength`` 0 the neuron is LIF. A reset by subtraction
takes off the threshold that the spike crossed, before its own rise. Like LIF, U(t) is the membrane *before* the reset
that its own spike causes.

After the LSNN of Bellec et al. 2018 (arXiv 1803.09574), with three differences. There the adaptation jumps by
``1 - decay`` instead of 1 (their beta is ``strength / (1 - decay)``), the input is scaled by one minus the membrane's
decay, and the released code subtracts the threshold after its rise. snnTorch has no such neuron.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.spiking.layers import Array, NeuronNode
from switchmt_snn.spiking.neurons.base import NeuronLayer, NeuronState, constant_or_parameter


@dataclass(frozen=True)
class AdaptiveNode(NeuronNode):
    """Leaky neurons with an adaptive threshold.

    Attributes:
        beta_O: decay of the membrane per simulation step.
        threshold_O: threshold at rest.
        adaptation_decay_O: decay of the adaptation per simulation step.
        adaptation_strength_O: rise of the threshold by one spike.
        reset: ``zero`` or ``subtract`` (the threshold that was crossed).
    """

    beta_O: Array
    threshold_O: Array
    adaptation_decay_O: Array
    adaptation_strength_O: Array
    reset: str

    @property
    def kind(self) -> str:
        """``ALIF``."""
        return "ALIF"

    @property
    def states(self) -> tuple[str, ...]:
        """The membrane and the adaptation of the threshold."""
        return AdaptiveLayer.STATE


class AdaptiveLayer(NeuronLayer):
    """Leaky neurons with an adaptive threshold over T steps.

    Attributes:
        beta: decay of the membrane; a parameter if it is learned.
        threshold: threshold at rest; a parameter if it is learned.
    """

    STATE = ("membrane", "threshold_adaptation")
    beta: Tensor
    threshold: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        constant_or_parameter(self, "beta", config.beta, config.learn_beta)
        constant_or_parameter(self, "threshold", config.threshold, config.learn_threshold)
        self.decay, self.strength = config.adaptation_decay, config.adaptation_strength
        self.reset = config.reset

    def step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """The module's equations."""
        membrane, adaptation = state
        crossed = self.threshold + self.strength * adaptation
        spiked = self.surrogate(membrane - crossed)
        fired = spiked.detach()
        if self.reset == "zero":
            membrane = membrane * (1.0 - fired) * self.beta.clamp(0, 1) + current_t
        else:
            membrane = membrane * self.beta.clamp(0, 1) + current_t - fired * crossed
        adaptation = self.decay * adaptation + spiked
        spikes_t = self.surrogate(membrane - (self.threshold + self.strength * adaptation))
        return spikes_t, (membrane, adaptation)

    def node(self, channels: int) -> AdaptiveNode:
        """See ``AdaptiveNode``."""
        beta, threshold = float(self.beta.detach().clamp(0, 1)), float(self.threshold.detach())
        return AdaptiveNode(
            beta_O=np.full(channels, beta),
            threshold_O=np.full(channels, threshold),
            adaptation_decay_O=np.full(channels, self.decay),
            adaptation_strength_O=np.full(channels, self.strength),
            reset=self.reset,
        )
