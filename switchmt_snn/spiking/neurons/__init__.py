"""Neuron models: one file each, registered by the name that ``network.neuron`` takes.

| name | class | state | file |
|---|---|---|---|
| IF, LIF | LeakyLayer | membrane | leaky.py |
| Synaptic | SynapticLayer | current, membrane | synaptic.py |
| ALIF | AdaptiveLayer | membrane, threshold_adaptation | adaptive.py |

The ANN methods have ReLULayer (relu.py). A class from outside the package is named ``package.module:Class``.
"""

from __future__ import annotations

from typing import Any

from switchmt_snn.config import NetworkConfig
from switchmt_snn.config.plugins import is_plugin
from switchmt_snn.config.registry import Registry
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.neurons.adaptive import AdaptiveLayer, AdaptiveNode
from switchmt_snn.spiking.neurons.base import NeuronLayer, NeuronState, OpaqueNode
from switchmt_snn.spiking.neurons.check import check_neuron
from switchmt_snn.spiking.neurons.leaky import LeakyLayer, LeakyNode
from switchmt_snn.spiking.neurons.relu import ReLULayer, ReLUNode
from switchmt_snn.spiking.neurons.surrogates import (
    DEFAULT_SLOPE,
    SURROGATES,
    make_surrogate,
    make_surrogate_gradient,
)
from switchmt_snn.spiking.neurons.synaptic import SynapticLayer, SynapticNode


def _checked(model: Any, name: str) -> type[NeuronLayer]:
    if not (isinstance(model, type) and issubclass(model, NeuronLayer)):
        raise ConfigError(
            f"network.neuron is {name!r}, expected a subclass of switchmt_snn.spiking.neurons.NeuronLayer; "
            "see docs/extending.md"
        )
    return model


NEURONS: Registry[type[NeuronLayer]] = Registry(NetworkConfig, "network.neuron", _checked)
"""Spiking neuron models by the name that ``network.neuron`` takes."""

register_neuron, neuron_model = NEURONS.register, NEURONS.find

register_neuron("IF")(LeakyLayer)
register_neuron("LIF")(LeakyLayer)
register_neuron("Synaptic")(SynapticLayer)
register_neuron("ALIF")(AdaptiveLayer)


def make_neuron_layer(config: NetworkConfig, spiking: bool) -> NeuronLayer:
    """A new layer of the model that ``config.neuron`` names, or of ReLUs for an ANN method.

    Raises:
        ConfigError: see ``neuron_model``; the model does not have a setting's value; or a class from outside the
            package does not keep the contract (``check_neuron``).
    """
    model = neuron_model(config.neuron) if spiking else ReLULayer
    if spiking and is_plugin(config.neuron):
        check_neuron(model, config)
    return model(config)


__all__ = [
    "DEFAULT_SLOPE",
    "NEURONS",
    "SURROGATES",
    "AdaptiveLayer",
    "AdaptiveNode",
    "LeakyLayer",
    "LeakyNode",
    "NeuronLayer",
    "NeuronState",
    "OpaqueNode",
    "ReLULayer",
    "ReLUNode",
    "SynapticLayer",
    "SynapticNode",
    "check_neuron",
    "make_neuron_layer",
    "make_surrogate",
    "make_surrogate_gradient",
    "neuron_model",
    "register_neuron",
]
