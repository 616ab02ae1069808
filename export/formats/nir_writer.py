"""NIR graphs of a folded network: one graph per task, on the nodes that other simulators read.

The graph takes the encoded input of one simulation step and ends at the head's Affine; the host encodes, runs T steps
and applies the readout (mean: averages the outputs). An action that the task does not have gets a bias so low that it
is never the largest (``never_choosing_others``). NIR is continuous in time: ``dt`` is the length of one simulation step
that makes the discrete network of ``switchmt_snn.spiking.neurons`` out of it by explicit Euler steps.

Dialects:

- ``portable``: Input, Conv2d, IF or LIF, Flatten, Affine, Output; dt = 1 and r = 1; reset to zero. A LIF's input is
  scaled by tau / dt = 1 / (1 - beta) in the weights, because importers ignore or restrict r.
- ``spikingjelly``: the same for an importer that requires IF.r = 1 / dt, with its default dt = 1e-4.
- ``exact``: also reset by subtraction, as a loop: an integrator (I, or LI with its own r), a Threshold, and a Scale by
  minus the threshold back into the integrator, one step later. Synaptic neurons have one more LI for their current.
- ``legacy``: no ``v_reset`` in the file, so that nir <= 1.0.5 reads it; how a spike resets is in the metadata only.

Each node of the network has one rule: ``export_synapses`` and ``export_neurons`` of this module. A node without a rule
is refused by name; a neuron from outside the package registers its own (docs/extending.md, Neuron). No dialect uses
nir.CubaLIF: it resets at the spike, while ``snntorch.Synaptic`` resets after the input of the next step.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field, replace
from functools import singledispatch
from pathlib import Path
from typing import Any, Literal, cast

import h5py
import nir
import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import ExportError
from switchmt_snn.export.folded import metadata
from switchmt_snn.runs.files import write_atomically
from switchmt_snn.spiking.folding import FoldedNetwork
from switchmt_snn.spiking.layers import Array, Conv, Dense, Float, Layer, NeuronNode, SynapseNode, no_rule
from switchmt_snn.spiking.neurons import AdaptiveNode, LeakyNode, ReLUNode, SynapticNode

NirDialect = Literal["portable", "spikingjelly", "exact", "legacy"]
DIALECT_KEY = "profile"
"""Metadata key of a file's dialect; files of older versions have it, too."""
_DT = {"portable": 1.0, "spikingjelly": 1e-4, "exact": 1.0, "legacy": 1.0}
_NEURON_REMEDY = "a neuron of your own needs a node() and a NIR rule: docs/extending.md, Neuron"


@dataclass
class Chain:
    """A NIR graph while it grows; each appended node hears the one before it."""

    last: str
    nodes: dict[str, nir.NIRNode] = field(default_factory=dict)
    edges: list[tuple[str, str]] = field(default_factory=list)

    def append(self, name: str, node: nir.NIRNode) -> None:
        """Add a node that hears the last one."""
        self.nodes[name] = node
        self.edges.append((self.last, name))
        self.last = name

    def feed_back(self, name: str, node: nir.NIRNode, to: str) -> None:
        """Close a loop: a node that hears the last one and is heard, one step later, by the node ``to``."""
        self.nodes[name] = node
        self.edges += [(self.last, name), (name, to)]


def nir_graph(network: FoldedNetwork, task: int, dialect: NirDialect = "portable") -> nir.NIRGraph:
    """The graph of one task.

    Raises:
        ExportError: the network has no exact expression in the dialect (ANN, k winners, reset by subtraction), or a
            node without a rule.
    """
    if dialect not in _DT:
        raise ExportError(f"the NIR dialect is {dialect!r}, expected one of {', '.join(_DT)}")
    network = network.of_task(task)
    chain = Chain("input", {"input": nir.Input({"input": np.array(network.encoded_shape)})})
    shape = network.encoded_shape
    for layer in network.layers:
        gain_O = input_gain_O(layer.neurons, dialect)
        export_synapses(layer.synapses, chain, shape, task, gain_O)
        export_neurons(layer.neurons, chain, layer, dialect)
        shape = layer.output_shape
    export_synapses(never_choosing_others(network, task), chain, shape, task, np.ones(1, np.float32))
    chain.append("output", nir.Output({"output": np.array(network.head.output_shape)}))
    facts = metadata(network) | {
        "task": network.tasks[task],
        "dt": _DT[dialect],
        DIALECT_KEY: dialect,
        "output": "head current of one step; readout over the T steps is the host's",
    }
    return nir.NIRGraph(chain.nodes, chain.edges, metadata=_storable(facts))


def never_choosing_others(network: FoldedNetwork, task: int) -> SynapseNode:
    """The head with a bias that keeps every action that the task does not have below all that it has.

    NIR has no -inf that importers take. The head hears spikes, so an output is within the sum of its weights' absolute
    values around its bias at every step, and so is what any readout makes of it.
    """
    head, valid_A = network.head, network.valid_actions_KA[task]
    if valid_A.all():
        return head
    weight, bias = head.folded(task)
    reach_A = np.abs(weight.astype(np.float64)).sum(axis=1)
    lowest = 2.0 * (reach_A + np.abs(bias))[valid_A].max() + 1.0
    shift_KO = head.shift_KO.copy()
    shift_KO[task, ~valid_A] = -(lowest + reach_A[~valid_A])
    return replace(head, shift_KO=shift_KO)


def write_nir(graph: nir.NIRGraph, path: Path) -> None:
    """Write a graph to a file; the ``legacy`` dialect leaves the all-zero ``v_reset`` out.

    HDF5 writes into memory: on a full disk it would fail once more whenever one of its objects is freed.

    Raises:
        WriteError: the system refused.
    """
    content = io.BytesIO()
    nir.write(content, graph)
    if dialect_of(graph) == "legacy":
        with h5py.File(content, "r+") as file:
            for node in cast(Any, file["node/nodes"]).values():
                if "v_reset" in node:
                    del node["v_reset"]
    write_atomically(path, content.getvalue())


def dialect_of(graph: nir.NIRGraph) -> NirDialect:
    """The dialect that a graph of this package is written in."""
    return cast(NirDialect, str(graph.metadata[DIALECT_KEY]))


@singledispatch
def export_synapses(node: SynapseNode, chain: Chain, shape: tuple[int, ...], task: int, gain_O: Float) -> None:
    """Append a layer's synapses, which see a signal of the given shape, with a factor on every output channel."""
    raise no_rule("NIR", node, export_synapses.registry, "add a rule to export/formats/nir_writer.py")


@export_synapses.register
def _(node: Conv, chain: Chain, shape: tuple[int, ...], task: int, gain_O: Float) -> None:
    weight, bias = _scaled(node, task, gain_O)
    height, width = node.input_shape[1:]
    stride, padding = _plain(node.stride), _plain(node.padding)
    kernel = nir.Conv2d(
        input_shape=(height, width), weight=weight, stride=stride, padding=padding, dilation=1, groups=1, bias=bias
    )
    chain.append(node.name, kernel)


@export_synapses.register
def _(node: Dense, chain: Chain, shape: tuple[int, ...], task: int, gain_O: Float) -> None:
    if node.k_winners is not None:
        raise ExportError(
            f"network.k_winners is {node.k_winners}, expected null; NIR cannot compare neurons: use --onnx"
        )
    if len(shape) > 1:
        chain.append("flatten", nir.Flatten({"input": np.array(shape)}, start_dim=0, end_dim=-1))
    weight, bias = _scaled(node, task, gain_O)
    chain.append(node.name, nir.Affine(weight=weight, bias=bias))


def _scaled(node: SynapseNode, task: int, gain_O: Float) -> tuple[Float, Float]:
    weight, bias = node.folded(task)
    return weight * gain_O.reshape(-1, *(1,) * (weight.ndim - 1)), bias * gain_O


def _plain(pair: tuple[int, int]) -> int | tuple[int, int]:
    """One number where both are equal, which more importers take."""
    return pair[0] if pair[0] == pair[1] else pair


@singledispatch
def input_gain_O(neurons: NeuronNode, dialect: str) -> Float:
    """Factor on the weights in front of the neurons, per output channel; 1 unless their NIR node scales its input."""
    return np.ones(1, np.float32)


@input_gain_O.register
def _(neurons: LeakyNode, dialect: str) -> Float:
    if not _decays(neurons.beta_O) or _needs_loop(neurons, dialect):
        return np.ones(1, np.float32)
    return (1.0 / (1.0 - _leak(neurons.beta_O))).astype(np.float32)


@singledispatch
def export_neurons(neurons: NeuronNode, chain: Chain, layer: Layer, dialect: str) -> None:
    """Append a layer's neurons, by node type; the node that spikes is called ``<layer>_neurons``.

    Args:
        neurons: the layer's, as its rule is picked by it.
        chain: hears the layer's currents; a rule appends nodes with parameters of the layer's full shape (``full``).
        layer: gives names and shapes.
        dialect: a rule refuses the ones that cannot express its neurons exactly.

    Raises:
        ExportError: a node without a rule, or a dialect that cannot express it.
    """
    remedy = "use --onnx" if isinstance(neurons, ReLUNode) else _NEURON_REMEDY
    raise no_rule("NIR", neurons, export_neurons.registry, remedy)


@export_neurons.register
def _(neurons: LeakyNode, chain: Chain, layer: Layer, dialect: str) -> None:
    _refuse_reset_owed_at_rest(neurons)
    if neurons.reset == "subtract" and dialect == "legacy" and _decays(neurons.beta_O):
        raise ExportError(
            "LIF neurons reset by subtraction, expected IF for the NIR dialect 'legacy': its importers subtract at the "
            "spike, before the membrane decays; use --nir-dialect exact"
        )
    if neurons.reset == "subtract" and dialect in ("portable", "spikingjelly"):
        others = "" if _decays(neurons.beta_O) else " or legacy (sinabs)"
        raise ExportError(
            f"the network resets by subtraction, expected reset to zero for the NIR dialect {dialect!r} (that is what "
            f"importers of nir.{neurons.kind} do); use --nir-dialect exact (any simulator with loops){others}"
        )
    if _needs_loop(neurons, dialect):
        _append_loop(neurons, chain, layer, _DT[dialect])
    else:
        chain.append(f"{layer.name}_neurons", _leaky(neurons, layer, _DT[dialect]))


@export_neurons.register
def _(neurons: SynapticNode, chain: Chain, layer: Layer, dialect: str) -> None:
    if neurons.reset != "subtract" or dialect != "exact":
        raise ExportError(
            f"Synaptic neurons reset by {neurons.reset!r} in the NIR dialect {dialect!r}, expected 'subtract' and "
            "exact: nir.CubaLIF resets at the spike, snnTorch's Synaptic after the next input; use --onnx, or "
            "network.reset subtract and --nir-dialect exact"
        )
    _refuse_reset_owed_at_rest(neurons)
    chain.append(f"{layer.name}_current", _integrator(layer, neurons.alpha_O, _DT[dialect]))
    _append_loop(neurons, chain, layer, _DT[dialect])


@export_neurons.register
def _(neurons: AdaptiveNode, chain: Chain, layer: Layer, dialect: str) -> None:
    raise ExportError("NIR cannot express ALIF: no node has a threshold that changes; use --onnx")


def _refuse_reset_owed_at_rest(neurons: LeakyNode | SynapticNode) -> None:
    """A membrane at rest that is above its threshold is reset at the first step. NIR knows no such spike before it."""
    if neurons.reset == "subtract" and (neurons.threshold_O < 0).any():
        raise ExportError(
            f"a learned threshold is {neurons.threshold_O.min():.4g}, expected at least 0 for NIR with reset by "
            "subtraction: it is subtracted at the first step, before any spike; use --onnx"
        )


def _decays(decay_O: Array) -> bool:
    return bool((decay_O != 1.0).any())


def _needs_loop(neurons: LeakyNode, dialect: str) -> bool:
    return dialect == "exact" and neurons.reset == "subtract"


def _leak(decay_O: Array) -> Array:
    if (decay_O >= 1.0).any():
        raise ExportError("some of a layer's neurons have a decay of 1 and thus no time constant, expected all or none")
    return decay_O


def _leaky(neurons: LeakyNode, layer: Layer, dt: float) -> nir.NIRNode:
    """IF or LIF with parameters of the layer's full shape (importers do not broadcast)."""
    threshold, zero = full(layer, neurons.threshold_O), full(layer, 0.0)
    if not _decays(neurons.beta_O):
        return nir.IF(r=full(layer, 1.0 / dt), v_threshold=threshold, v_reset=zero)
    tau = full(layer, dt / (1.0 - _leak(neurons.beta_O)))
    return nir.LIF(tau=tau, r=full(layer, 1.0), v_leak=zero, v_threshold=threshold, v_reset=zero.copy())


def _integrator(layer: Layer, decay_O: Array, dt: float) -> nir.NIRNode:
    """``v(t) = decay v(t-1) + x(t)``."""
    if not _decays(decay_O):
        return nir.I(r=full(layer, 1.0 / dt))
    tau = dt / (1.0 - _leak(decay_O))
    return nir.LI(tau=full(layer, tau), r=full(layer, tau / dt), v_leak=full(layer, 0.0))


def _append_loop(neurons: LeakyNode | SynapticNode, chain: Chain, layer: Layer, dt: float) -> None:
    """``U(t) = beta U(t-1) + I(t) - threshold S(t-1)``; the Threshold carries the layer's neuron name."""
    membrane, reset = f"{layer.name}_membrane", f"{layer.name}_reset"
    chain.append(membrane, _integrator(layer, neurons.beta_O, dt))
    chain.append(f"{layer.name}_neurons", nir.Threshold(threshold=full(layer, neurons.threshold_O)))
    chain.feed_back(reset, nir.Scale(scale=full(layer, -neurons.threshold_O)), membrane)


def full(layer: Layer, value_O: npt.ArrayLike) -> Float:
    """A parameter of every neuron of a layer, from one number or one per output channel."""
    by_channel = np.reshape(value_O, (-1, *(1,) * (len(layer.output_shape) - 1)))
    return np.ascontiguousarray(np.broadcast_to(by_channel, layer.output_shape), np.float32)


def _storable(facts: dict[str, Any]) -> dict[str, Any]:
    """Metadata that survives an HDF5 file: strings, numbers, arrays and dicts (a list of strings would not)."""
    stored: dict[str, Any] = {}
    for key, value in facts.items():
        if isinstance(value, dict):
            stored[key] = _storable(value)
        elif isinstance(value, list) and value and isinstance(value[0], str):
            stored[key] = ",".join(value)
        else:
            stored[key] = np.asarray(value) if isinstance(value, list) else value
    return stored
