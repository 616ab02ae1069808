"""NIR graphs of a folded network: one graph per task, on the nodes that other simulators read.

The graph takes the encoded input of one simulation step and ends at the head's Affine; the host encodes, runs T steps
and applies the readout (mean: averages the outputs). NIR is continuous in time: ``dt`` is the length of one simulation
step that makes the discrete network of :mod:`switchmt_snn.spiking.neurons` out of it by explicit Euler steps.

Profiles:

- ``portable``: Input, Conv2d, IF or LIF, Flatten, Affine, Output; dt = 1 and r = 1; reset to zero. A LIF's input is
  scaled by tau / dt = 1 / (1 - beta) in the weights, because importers ignore or restrict r.
- ``spikingjelly``: the same for an importer that requires IF.r = 1 / dt, with its default dt = 1e-4.
- ``exact``: also reset by subtraction, as a loop: an integrator (I, or LI with its own r), a Threshold, and a Scale by
  minus the threshold back into the integrator, one step later.
- ``legacy``: no ``v_reset`` in the file, so that nir <= 1.0.4 reads it; how a spike resets is in the metadata only.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, cast

import h5py
import nir
import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import ExportError
from switchmt_snn.export.folding import FoldedNetwork, Layer, Neurons, metadata

NirProfile = Literal["portable", "spikingjelly", "exact", "legacy"]
_DT = {"portable": 1.0, "spikingjelly": 1e-4, "exact": 1.0, "legacy": 1.0}

Float = npt.NDArray[np.float32]


def nir_graph(network: FoldedNetwork, task: int, profile: NirProfile = "portable") -> nir.NIRGraph:
    """The graph of one task.

    Raises:
        ExportError: the network has no exact expression in the profile (ANN, k winners, reset by subtraction).
    """
    _check(network, profile)
    nodes: dict[str, nir.NIRNode] = {"input": nir.Input({"input": np.array(network.encoded_shape)})}
    edges: list[tuple[str, str]] = []
    last = "input"

    def append(name: str, node: nir.NIRNode) -> None:
        nonlocal last
        nodes[name] = node
        edges.append((last, name))
        last = name

    shape = network.encoded_shape
    for layer in network.layers:
        if not layer.is_convolution and len(shape) > 1:
            append("flatten", nir.Flatten({"input": np.array(shape)}, start_dim=0, end_dim=-1))
        append(layer.name, _synapses(layer, task, profile))
        shape = layer.output_shape
        if layer.neurons is not None:
            append_neurons = _loop if _needs_loop(layer.neurons, profile) else _node
            append_neurons(layer, nodes, edges, profile)
            last = f"{layer.name}_neurons"
    nodes["output"] = nir.Output({"output": np.array(shape)})
    edges.append((last, "output"))
    facts = metadata(network) | {
        "task": network.suite.names[task],
        "dt": _DT[profile],
        "profile": profile,
        "output": "head current of one step; readout over the T steps is the host's",
    }
    return nir.NIRGraph(nodes, edges, metadata=_storable(facts))


def can_express(network: FoldedNetwork, profile: NirProfile = "portable") -> bool:
    """Whether :func:`nir_graph` has an exact graph for the network."""
    try:
        _check(network, profile)
    except ExportError:
        return False
    return True


def write_nir(graph: nir.NIRGraph, path: Path) -> None:
    """Write a graph to a file; the ``legacy`` profile leaves the all-zero ``v_reset`` out."""
    nir.write(path, graph)
    if graph.metadata["profile"] == "legacy":
        with h5py.File(path, "a") as file:
            for node in cast(Any, file["node/nodes"]).values():
                if "v_reset" in node:
                    del node["v_reset"]


def _check(network: FoldedNetwork, profile: str) -> None:
    settings = network.config.network
    if not network.spiking:
        raise ExportError(
            f"{settings.method} has ReLU neurons, expected a spiking method; NIR has no ReLU node: use --onnx"
        )
    if settings.k_winners is not None:
        raise ExportError(
            f"network.k_winners is {settings.k_winners}, expected null; NIR cannot compare neurons: use --onnx"
        )
    if settings.reset == "subtract" and profile in ("portable", "spikingjelly"):
        raise ExportError(
            f"the network resets by subtraction, expected reset to zero for the NIR profile {profile!r} (that is what "
            "importers of nir.IF do); use --nir-profile exact (any simulator with loops) or legacy (sinabs)"
        )


def _needs_loop(neurons: Neurons, profile: str) -> bool:
    return profile == "exact" and neurons.reset == "subtract"


def _input_gain_O(layer: Layer, profile: str) -> Float:
    """Factor on the weights in front of a LIF node whose r is 1, per output channel."""
    neurons = layer.neurons
    if neurons is None or neurons.kind != "LIF" or _needs_loop(neurons, profile):
        return np.ones(1, np.float32)
    return (1.0 / (1.0 - _leak(neurons))).astype(np.float32)


def _leak(neurons: Neurons) -> npt.NDArray[np.float64]:
    if (neurons.beta_O >= 1.0).any():
        raise ExportError("a LIF neuron has beta 1 and thus no time constant, expected beta < 1 or network.neuron IF")
    return neurons.beta_O


def _synapses(layer: Layer, task: int, profile: str) -> nir.NIRNode:
    weight, bias = layer.folded(task)
    gain_O = _input_gain_O(layer, profile)
    weight, bias = weight * gain_O.reshape(-1, *(1,) * (weight.ndim - 1)), bias * gain_O
    if not layer.is_convolution:
        return nir.Affine(weight=weight, bias=bias)
    height, width = layer.input_shape[1:]
    stride = cast(int, layer.stride)
    return nir.Conv2d(
        input_shape=(height, width), weight=weight, stride=stride, padding=0, dilation=1, groups=1, bias=bias
    )


def _node(layer: Layer, nodes: dict[str, nir.NIRNode], edges: list[tuple[str, str]], profile: str) -> None:
    """IF or LIF with parameters of the layer's full shape (importers do not broadcast)."""
    neurons, dt = cast(Neurons, layer.neurons), _DT[profile]
    name = f"{layer.name}_neurons"
    threshold, zero = _full(layer, neurons.threshold_O), _full(layer, 0.0)
    if neurons.kind == "IF":
        nodes[name] = nir.IF(r=_full(layer, 1.0 / dt), v_threshold=threshold, v_reset=zero)
    else:
        tau = _full(layer, dt / (1.0 - _leak(neurons)))
        nodes[name] = nir.LIF(tau=tau, r=_full(layer, 1.0), v_leak=zero, v_threshold=threshold, v_reset=zero.copy())
    edges.append((layer.name, name))


def _loop(layer: Layer, nodes: dict[str, nir.NIRNode], edges: list[tuple[str, str]], profile: str) -> None:
    """``U(t) = beta U(t-1) + I(t) - threshold S(t-1)``; the Threshold carries the layer's neuron name."""
    neurons, dt = cast(Neurons, layer.neurons), _DT[profile]
    membrane, name, reset = f"{layer.name}_membrane", f"{layer.name}_neurons", f"{layer.name}_reset"
    if neurons.kind == "IF":
        nodes[membrane] = nir.I(r=_full(layer, 1.0 / dt))
    else:
        tau = dt / (1.0 - _leak(neurons))
        nodes[membrane] = nir.LI(tau=_full(layer, tau), r=_full(layer, tau / dt), v_leak=_full(layer, 0.0))
    nodes[name] = nir.Threshold(threshold=_full(layer, neurons.threshold_O))
    nodes[reset] = nir.Scale(scale=_full(layer, -neurons.threshold_O))
    edges += [(layer.name, membrane), (membrane, name), (name, reset), (reset, membrane)]


def _full(layer: Layer, value_O: npt.ArrayLike) -> Float:
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
