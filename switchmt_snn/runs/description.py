"""What a config would build, before anything runs: layers, parameters, neurons, operations, memory."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, cast

from switchmt_snn.config import METHOD_TRAITS, METHODS, ExperimentConfig, resolve
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.runs.memory import MemoryEstimate, estimate_memory
from switchmt_snn.spiking.folding import network_nodes
from switchmt_snn.spiking.layers import SynapseNode
from switchmt_snn.spiking.network import (
    QNetwork,
    Stream,
    build_network,
    deployed_parameters,
    trainable_parameters,
)
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import TaskSuite


@dataclass(frozen=True)
class LayerDescription:
    """One layer of synapses.

    Attributes:
        operations_per_step: dense operations of one simulation step: every weight meets every input it is wired to,
            padding not counted (a spiking layer does at most this many accumulates per step).
        steps: how often the layer is computed per decision in the deployed network, as ``profile`` counts it: once for
            the first layer under direct encoding, otherwise T times. (In PyTorch a mean readout's head is computed
            once, on the mean spikes.)
    """

    name: str
    kind: str
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    parameters: int
    neurons: int
    operations_per_step: int
    steps: int


@dataclass(frozen=True)
class MethodDescription:
    """One of the seven methods under a config's other settings.

    Attributes:
        deployed_parameters: of the network that decides for one task; with quantiles or heads per task fewer than are
            trained.
    """

    method: str
    trainable_parameters: int
    deployed_parameters: int
    neurons: int
    timesteps: int
    dense_operations_per_decision: int
    neuron_updates_per_decision: int
    switching_policy: str
    layers: tuple[LayerDescription, ...]
    memory: MemoryEstimate

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**asdict(self), "memory_total_bytes": self.memory.total_bytes}


def describe(config: ExperimentConfig) -> dict[str, MethodDescription]:
    """Describe every method under a config's settings (those that a method cannot have fall back to its own).

    Args:
        config: not resolved, so that T of the spiking methods is known where the config's own method is an ANN.
    """
    suite = make_suite(resolve(config).tasks)
    return {method: describe_method(with_method(config, method), suite) for method in METHODS}


def with_method(config: ExperimentConfig, method: str) -> ExperimentConfig:
    """The config with another method, resolved; settings that the method cannot have take its own values."""
    if method == config.network.method:
        return resolve(config)
    traits = METHOD_TRAITS[method]
    keeps = traits.dendrites and config.network.dendrites != "none"
    changes: dict[str, Any] = {"method": method, "dendrites": config.network.dendrites if keeps else "auto"}
    if not traits.spiking:
        changes |= {"encoding": "direct", "readout": "mean", "k_winners": None}
    network = replace(config.network, **changes)
    return resolve(replace(config, network=network, switching=replace(config.switching, policy="auto", options=())))


def describe_method(config: ExperimentConfig, suite: TaskSuite) -> MethodDescription:
    """Describe the method of a resolved config."""
    network = build_network(config.network, observation_spec(suite), config.seed)
    layers = tuple(_layers(network))
    neurons = sum(layer.neurons for layer in layers)
    return MethodDescription(
        method=config.network.method,
        trainable_parameters=trainable_parameters(network),
        deployed_parameters=deployed_parameters(network),
        neurons=neurons,
        timesteps=config.network.timesteps,
        dense_operations_per_decision=sum(layer.operations_per_step * layer.steps for layer in layers),
        neuron_updates_per_decision=neurons * config.network.timesteps,
        switching_policy=config.switching.policy,
        layers=layers,
        memory=estimate_memory(config, suite, network, neurons),
    )


def _layers(network: QNetwork) -> list[LayerDescription]:
    """The network's nodes, each stream's hidden layer and head apart."""
    steps, nodes = network.config.timesteps, network_nodes(network)
    first_steps = 1 if network.encoder.constant_over_time else steps
    layers = []
    for layer in nodes.trunk:
        owned = trainable_parameters(network.trunk[layer.name])
        layers.append(_described(layer.synapses, owned, first_steps, neurons=True))
        first_steps = steps
    for name, stream in nodes.streams.items():
        module = cast(Stream, network.streams[name])
        head = trainable_parameters(module.head)
        owned = trainable_parameters(module) - head
        layers.append(_described(stream.hidden.synapses, owned, first_steps, neurons=True))
        layers.append(_described(stream.head, head, steps, neurons=False))
    return layers


def _described(node: SynapseNode, parameters: int, steps: int, neurons: bool) -> LayerDescription:
    return LayerDescription(
        name=node.name,
        kind=node.kind,
        input_shape=node.input_shape,
        output_shape=node.output_shape,
        parameters=parameters,
        neurons=node.outputs if neurons else 0,
        operations_per_step=node.dense_operations,
        steps=steps,
    )
