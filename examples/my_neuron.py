"""A neuron model of one's own, for 04_own_neuron.py: the step is the whole model."""

from __future__ import annotations

from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.neurons import NeuronLayer, NeuronState


class RefractoryIF(NeuronLayer):
    """Integrate and fire; a neuron that fired ignores the input of the next step.

    Per step::

        U(t) = (1 - S(t-1)) (U(t-1) + I(t))
        S(t) = H(U(t) - threshold)               gradient: the surrogate that the config names
    """

    STATE = ("membrane", "fired")

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        if config.reset != "zero":
            raise ConfigError(f"network.reset is {config.reset!r}, expected 'zero' for RefractoryIF")
        self.threshold = config.threshold

    def step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """The equations above, for currents ``[B, ...]``."""
        membrane, fired = state
        membrane = (1.0 - fired.detach()) * (membrane + current_t)
        spikes_t = self.surrogate(membrane - self.threshold)
        return spikes_t, (membrane, spikes_t)
