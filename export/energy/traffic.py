"""Memory accesses of a layer, after Lemaire et al. (ICONIP 2022, arXiv 2210.13107), Eqs. 3 to 15.

A spiking layer is event-driven: every input spike reads a weight for each neuron that it reaches, and reads and writes
that neuron's membrane; every step adds the bias to every membrane. A formal layer keeps its sum in a register: every
multiplication reads a weight and, in a convolution, an input (a linear layer reads each input once). Neither side
reuses weights. Where the model takes a whole kernel per spike, exact effective operations stand here.
"""

from __future__ import annotations

from dataclasses import dataclass

from switchmt_snn.export.counts.network import LayerCounts


@dataclass(frozen=True)
class Traffic:
    """Mean accesses of one layer per decision.

    Attributes:
        events: input spikes read from a queue and output spikes written to one.
        activations: formal inputs read and outputs written.
        weights: weights read.
        biases: biases read.
        state: membranes (or the head's sums) read and written.
    """

    events: float
    activations: float
    weights: float
    biases: float
    state: float


def traffic(layer: LayerCounts, spiking: bool) -> Traffic:
    """Of a layer as it was counted; ``spiking`` tells whether its network's neurons spike."""
    accumulates = layer.operation == "AC"
    passes = len(layer.effective_T)
    inputs = layer.effective_per_decision if layer.convolution else layer.active_inputs_per_decision
    state = 0.0
    if accumulates:
        state = 2 * (layer.effective_per_decision + layer.outputs * passes)
    elif spiking:
        state = 2 * layer.neuron_updates_per_decision
    if spiking:  # what a neuron keeps beyond the variable that its inputs change is read and written once a step
        state += 2 * max(0, layer.states - 1) * layer.neuron_updates_per_decision
    fires = spiking and layer.neurons > 0
    return Traffic(
        events=(layer.active_inputs_per_decision if accumulates else 0) + (layer.spikes_per_decision if fires else 0),
        activations=(0 if accumulates else inputs) + (0 if fires else layer.outputs),
        weights=layer.effective_per_decision,
        biases=layer.outputs * passes,
        state=state,
    )


def ann_traffic(layer: LayerCounts) -> Traffic:
    """Of the same layer in the ANN of the same shape."""
    macs = layer.macs_of_ann_twin
    inputs = macs if layer.convolution else layer.inputs
    return Traffic(events=0, activations=inputs + layer.outputs, weights=macs, biases=layer.outputs, state=0)
