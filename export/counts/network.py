"""What a network does while it plays: spikes and operations by layer, step and task, counted on recorded decisions.

Counted is the network as it is deployed: one task folded in, the head fed with every step's spikes, the first layer
computed once per decision under direct encoding (its input does not change). Definitions:
``switchmt_snn.export.counts.synapses``.

Twins stand beside it: the ANN of the same shape does one multiplication per weight and position (dense), and the
quantised ANN does the same on activations of ceil(log2(T + 1)) bits, as many values as a spike count over T can take.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.acting.agent import Agent
from switchmt_snn.errors import ExportError
from switchmt_snn.export.counts.synapses import CountedSynapses, NeuronCounter, SynapseCounter
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.parity.activity import active_neurons, chunks
from switchmt_snn.export.runtimes.agents import encode
from switchmt_snn.spiking.folding import FoldedNetwork
from switchmt_snn.spiking.layers import Dense, SynapseNode


@dataclass(frozen=True)
class LayerCounts:
    """Sums over all recorded decisions of one task; ``_T`` are by simulation step.

    Attributes:
        convolution: whether its synapses are a convolution.
        operation: what one synaptic operation is here: ``AC`` (spikes come in) or ``MAC``.
        effective_T: synaptic operations that a non-zero input causes.
        active_inputs_T: inputs that were not zero.
        inputs: inputs of the layer.
        dense_per_decision: operations of all its passes with every input and weight counted.
        weights: its non-zero weights.
        outputs: values that it computes at a step: its neurons, or the head's actions.
        neurons: neurons that it feeds; 0 for the head.
        states: state variables of one of them; 1 for the head, which adds up.
        spikes_T: spikes of those neurons (for an ANN: activations above zero).
        silent: neurons that never fired.
        saturated: neurons that always fired.
        rate_histogram: neurons that fired, by spikes per step, in equal bins from 0 to 1.
        neuron_updates_per_decision: membrane updates.
        gain_multiplications_per_decision: of the active dendrites, if they are not folded into the weights.
    """

    name: str
    convolution: bool
    operation: str
    decisions: int
    effective_T: tuple[int, ...]
    active_inputs_T: tuple[int, ...]
    inputs: int
    dense_per_decision: int
    weights: int
    outputs: int
    neurons: int
    states: int
    spikes_T: tuple[int, ...]
    silent: int
    saturated: int
    rate_histogram: tuple[int, ...]
    neuron_updates_per_decision: int
    gain_multiplications_per_decision: int

    @property
    def effective_per_decision(self) -> float:
        """Mean synaptic operations."""
        return sum(self.effective_T) / self.decisions

    @property
    def macs_of_ann_twin(self) -> int:
        """Multiplications of this layer in the ANN of the same shape: every weight at every position, once."""
        return self.dense_per_decision // max(1, len(self.effective_T))

    @property
    def active_inputs_per_decision(self) -> float:
        """Mean inputs that are not zero, over all passes."""
        return sum(self.active_inputs_T) / self.decisions

    @property
    def spikes_per_decision(self) -> float:
        """Mean spikes."""
        return sum(self.spikes_T) / self.decisions

    @property
    def rate(self) -> float:
        """Spikes per neuron and simulation step."""
        steps = max(1, len(self.spikes_T))
        return self.spikes_per_decision / (self.neurons * steps) if self.neurons else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Plain values, sums and means."""
        return {
            **{name: list(v) if isinstance(v, tuple) else v for name, v in vars(self).items()},
            "effective_per_decision": self.effective_per_decision,
            "spikes_per_decision": self.spikes_per_decision,
            "rate": self.rate,
        }


@dataclass(frozen=True)
class TaskCounts:
    """The layers of one task, in forward order."""

    task: str
    decisions: int
    timesteps: int
    spiking: bool
    layers: tuple[LayerCounts, ...]

    def operations(self, kind: str) -> float:
        """Mean effective operations per decision of a kind, ``AC`` or ``MAC``."""
        return sum(layer.effective_per_decision for layer in self.layers if layer.operation == kind)

    @property
    def dense_macs_of_ann_twin(self) -> int:
        """Multiplications of the ANN of the same shape: every weight at every position, once."""
        return sum(layer.macs_of_ann_twin for layer in self.layers)

    @property
    def activation_bits(self) -> int:
        """Bits of the quantised twin's activations: as many values as a spike count over T has."""
        return math.ceil(math.log2(self.timesteps + 1))

    @property
    def spikes(self) -> float:
        """Mean spikes per decision."""
        return sum(layer.spikes_per_decision for layer in self.layers)

    @property
    def spikes_per_synapse(self) -> float:
        """Accumulations per synapse and decision, over the layers that spikes feed (break-even: 0.15 to 1.38,
        Dampfhoffer et al., IEEE TETCI 7(3):731, 2023)."""
        fed = [layer for layer in self.layers if layer.operation == "AC"]
        synapses = sum(layer.macs_of_ann_twin for layer in fed)
        return sum(layer.effective_per_decision for layer in fed) / synapses if fed else 0.0

    @property
    def rate(self) -> float:
        """Spikes per neuron and simulation step (break-even with a quantised ANN: 0.057 at T = 5, arXiv 2409.08290)."""
        neurons = sum(layer.neurons for layer in self.layers)
        return self.spikes / (neurons * self.timesteps)

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        macs = self.dense_macs_of_ann_twin
        return {
            "task": self.task,
            "decisions": self.decisions,
            "per_decision": {
                "spikes": self.spikes,
                "acs": self.operations("AC"),
                "macs": self.operations("MAC"),
                "dense": sum(layer.dense_per_decision for layer in self.layers),
                "neuron_updates": sum(layer.neuron_updates_per_decision for layer in self.layers),
                "gain_multiplications": sum(layer.gain_multiplications_per_decision for layer in self.layers),
            },
            "spikes_per_synapse": self.spikes_per_synapse,
            "rate": self.rate,
            "twins": {
                "ann": {"macs": macs},
                "quantised_ann": {"macs": macs, "activation_bits": self.activation_bits} if self.spiking else None,
            },
            "layers": [layer.to_dict() for layer in self.layers],
        }


class TaskCounter:
    """Counts one task's decisions as they come; its memory does not grow with their number."""

    def __init__(self, agent: Agent, task: int) -> None:
        """Start at nothing; ``task`` is a task's index."""
        self.agent, self.task, self.network = agent, task, fold_agent(agent).of_task(task)
        self._synapses = [SynapseCounter(_counted(self.network, node, task)) for node in self.network.synapses]
        self._steps = self.network.settings.timesteps
        self._neurons = [NeuronCounter(layer.name, layer.output_shape, self._steps) for layer in self.network.layers]
        self._chunks = 0

    def add(self, observations: npt.NDArray[Any]) -> None:
        """Count raw observations ``[N, *shape]``.

        Raises:
            ExportError: none, or observations of another shape.
        """
        expected = self.agent.suite.observation_shape
        if len(observations) == 0 or observations.shape[1:] != expected:
            raise ExportError(
                f"the recorded observations have shape {observations.shape}, expected "
                f"(N, {', '.join(map(str, expected))}) with N >= 1; record them again"
            )
        once = self.network.constant_input
        for chunk in chunks(observations):
            # Each chunk has random numbers of its own, for random encodings.
            encoded_TB = encode(self.agent.suite, self.agent.config, chunk, self._chunks)
            active = active_neurons(self.agent, chunk, self.task, self._chunks).by_layer
            inputs = [encoded_TB[:1] != 0 if once else encoded_TB != 0, *active.values()]
            for counter, fed in zip(self._synapses, inputs, strict=True):
                counter.add(fed)
            for neuron_counter, fired in zip(self._neurons, active.values(), strict=True):
                neuron_counter.add(fired)
            self._chunks += 1

    def counts(self) -> TaskCounts:
        """What has been counted."""
        neurons: list[NeuronCounter | None] = [*self._neurons, None]
        layers = tuple(
            _layer_counts(self.network, *parts)
            for parts in zip(self.network.synapses, self._synapses, neurons, strict=True)
        )
        name, decisions = self.network.tasks[self.task], self._synapses[0].decisions
        return TaskCounts(name, decisions, self._steps, self.network.spiking, layers)


def count_task(agent: Agent, task: int, observations: npt.NDArray[Any]) -> TaskCounts:
    """Count one task's decisions on raw observations ``[N, *shape]``; ``task`` is its index.

    Raises:
        ExportError: no decisions, or observations of another shape.
    """
    counter = TaskCounter(agent, task)
    counter.add(observations)
    return counter.counts()


def _counted(network: FoldedNetwork, node: SynapseNode, task: int) -> CountedSynapses:
    """A layer's synapses with the weights of one task, as they are deployed."""
    spikes_in = network.sees_spikes if node is network.synapses[0] else network.spiking
    weight, _ = node.folded(task)
    deployed = replace(node, weight=weight.astype(np.float64), scale_KO=np.ones_like(node.scale_KO))
    return CountedSynapses(deployed, spikes_in)


def layer_counts(
    counter: SynapseCounter,
    neurons: NeuronCounter | None,
    outputs: int,
    updates: int,
    states: int,
    gain_multiplications: int = 0,
) -> LayerCounts:
    """What the two counters of a layer hold.

    Args:
        counter: of its synapses.
        neurons: of the neurons that they feed; None for a head.
        outputs: values that it computes at a step.
        updates: neuron updates per decision.
        states: state variables of one neuron.
        gain_multiplications: per decision.
    """
    return LayerCounts(
        name=counter.synapses.node.name,
        convolution=counter.synapses.shares_weights,
        operation=counter.synapses.operation,
        decisions=counter.decisions,
        effective_T=tuple(counter.operations_T.tolist()),
        active_inputs_T=tuple(counter.active_inputs_T.tolist()),
        inputs=len(counter.fan_out),
        dense_per_decision=counter.synapses.dense_operations() * len(counter.operations_T),
        weights=int(np.count_nonzero(counter.synapses.node.weight)),
        outputs=outputs,
        neurons=outputs if neurons is not None else 0,
        states=states,
        spikes_T=tuple(neurons.spikes_TN.sum(axis=1).tolist()) if neurons is not None else (),
        silent=neurons.silent if neurons is not None else 0,
        saturated=neurons.saturated if neurons is not None else 0,
        rate_histogram=neurons.rate_histogram if neurons is not None else (),
        neuron_updates_per_decision=updates,
        gain_multiplications_per_decision=gain_multiplications,
    )


def _layer_counts(
    network: FoldedNetwork, node: SynapseNode, counter: SynapseCounter, neurons: NeuronCounter | None
) -> LayerCounts:
    steps = network.settings.timesteps
    updates = node.outputs * steps if network.spiking and neurons is not None else 0
    gains = node.outputs * steps if isinstance(node, Dense) and node.gated else 0
    states = next((len(layer.neurons.states) for layer in network.layers if layer.synapses is node), 1)
    return layer_counts(counter, neurons, node.outputs, updates, states, gains)
