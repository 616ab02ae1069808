"""What a NIR file does on given inputs: spikes and operations by layer, counted in the reference interpreter.

An ``.npz`` file holds the inputs: raw ``observations`` for a graph with this package's metadata, which says how to
encode them, or encoded ``inputs`` for anybody's graph. A layer is a node with weights and the spiking node that it
feeds; what is counted, and how often, is as in ``switchmt_snn.export.counts.network``.

Shapes: T simulation steps, N decisions, B batch, ... a node's own shape.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import nir
import numpy as np
import numpy.typing as npt
import torch

from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ExportError, shown
from switchmt_snn.export.counts.network import LayerCounts, TaskCounts, layer_counts
from switchmt_snn.export.counts.nir_convention import NirConvention, doubts, require_stable, stated
from switchmt_snn.export.counts.synapses import CountedSynapses, NeuronCounter, SynapseCounter
from switchmt_snn.export.npz import read_npz
from switchmt_snn.export.parity.activity import chunks
from switchmt_snn.export.runtimes.agents import read_nir
from switchmt_snn.export.runtimes.nir_interpreter import Float, NirInterpreter
from switchmt_snn.machine.progress import progress_of
from switchmt_snn.spiking.encodings import ENCODINGS, make_encoding
from switchmt_snn.spiking.layers import Conv, Dense, convolved_sides

_SYNAPTIC = (nir.Conv2d, nir.Affine, nir.Linear)
_SPIKING = (nir.IF, nir.LIF, nir.CubaLIF, nir.Threshold)
_STATES = {nir.IF: 1, nir.LIF: 1, nir.CubaLIF: 2, nir.I: 1, nir.LI: 1}
"""State variables of one neuron by node."""
_FACTS = ("encoding", "timesteps", "observation_shape", "frame_stack", "scale")
"""Metadata that encoding raw observations needs."""
_NUMBERS = {"timesteps": int, "frame_stack": int, "scale": float, "event_threshold": float}

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class NirCounts:
    """What a NIR file did on given inputs.

    Attributes:
        counts: one layer per node with weights, in forward order. The task's name is the metadata's, or the file's.
        convention: how it was simulated.
        doubts: what looks wrong about that, in sentences; empty for a file of ours.
    """

    counts: TaskCounts
    convention: NirConvention
    doubts: tuple[str, ...]


def count_nir(path: Path, observations: Path, reset: str | None = None, fires_at_threshold: bool = False) -> NirCounts:
    """Count what a NIR file does; the time is that of the interpreter, the memory that of the ``.npz``.

    Args:
        path: a NIR file; one Input, one Output, nodes that ``NirInterpreter`` knows, one source per node with
            weights, weights before every spiking node.
        observations: an ``.npz`` with either ``observations``, raw ``[N, *shape]`` (the graph must have this package's
            metadata), or ``inputs``, encoded ``[T, N, *shape of the Input node]``; and, before the ``dt`` of the
            graph's metadata, ``dt``, the length of a simulation step.
        reset: what a spike does in the tool that wrote the file, one of
            ``switchmt_snn.export.runtimes.nir_interpreter.RESETS``; None takes the metadata's, else NIR's.
        fires_at_threshold: whether a membrane that is exactly at its threshold fires there.

    Raises:
        ExportError: one of the files cannot be read, they do not fit each other, dt is longer than a time constant, or
            a convention was stated for a file of ours.
    """
    graph, stored = read_nir(path), _arrays(observations)
    own = all(key in graph.metadata for key in _FACTS)
    facts = _checked(graph.metadata) if own else {}
    convention = stated(graph, own, _dt(graph, stored), reset, fires_at_threshold)
    require_stable(graph, convention.dt)
    interpreter = NirInterpreter(graph, convention.dt, convention.reset, fires_at_threshold)
    shape = _sides(graph.nodes[interpreter.input].input_type["input"])
    if "inputs" in stored:
        inputs = _encoded(stored["inputs"], shape, facts)
    elif own:
        inputs = _raw(stored["observations"], facts)
    else:
        raise ExportError(
            f"{path} does not say how to encode observations, expected the metadata {', '.join(_FACTS)} that "
            f"switchmt-snn writes; store encoded inputs of shape {_shape(('T', 'N', *shape))} as 'inputs' instead"
        )
    layers = _layers(interpreter, inputs)
    record = {name for layer in layers for name in (layer.source, layer.spiking) if name is not None}
    record.discard(interpreter.input)
    with progress_of(f"counting {path.name}", inputs.decisions, "decisions") as progress:
        for batch_TB in inputs.batches:
            _, recorded = interpreter.run(batch_TB, sorted(record))
            recorded[interpreter.input] = batch_TB[:1] if inputs.once else batch_TB
            for layer in layers:
                layer.add(recorded)
            progress.advance(batch_TB.shape[1])
    task = str(graph.metadata.get("task", path.stem))
    counts = TaskCounts(task, inputs.decisions, inputs.timesteps, True, tuple(layer.counts() for layer in layers))
    known = reset is not None or "reset" in graph.metadata
    return NirCounts(counts, convention, () if own else doubts(graph, convention, inputs.timesteps, known))


@dataclass(frozen=True)
class _Inputs:
    """What the Input node gets.

    Attributes:
        spikes: whether they are spikes, all of them.
        once: whether they are the same at every step, so that the first layer's synapses work once per decision.
        batches: encoded inputs ``[T, B, ...]``.
    """

    decisions: int
    timesteps: int
    spikes: bool
    once: bool
    batches: Iterator[Float]


@dataclass(frozen=True)
class _Layer:
    """A node with weights while it is being counted.

    Attributes:
        source: the node whose output is its input, flat or not.
        spiking: the node that it feeds, with its ``neurons``; None for a head.
        states: state variables of one neuron, in all nodes between the weights and the spikes.
    """

    synapses: SynapseCounter
    source: str
    outputs: int
    spiking: str | None
    neurons: NeuronCounter | None
    states: int

    def add(self, recorded: dict[str, Float]) -> None:
        """Count a batch: outputs ``[T, B, ...]`` by node."""
        self.synapses.add(recorded[self.source] != 0)
        if self.spiking is not None and self.neurons is not None:
            self.neurons.add(recorded[self.spiking] != 0)

    def counts(self) -> LayerCounts:
        """What has been counted."""
        updates = self.neurons.spikes_TN.size if self.neurons is not None else 0
        return layer_counts(self.synapses, self.neurons, self.outputs, updates, self.states)


def _layers(interpreter: NirInterpreter, inputs: _Inputs) -> list[_Layer]:
    """The graph's nodes with weights and what each of them feeds, in forward order."""
    nodes = interpreter.graph.nodes
    fed: dict[str, str] = {}
    states: dict[str, int] = {}
    for name in interpreter.order:
        if isinstance(nodes[name], _SPIKING):
            weights, states[name] = _feeding(interpreter, name)
            if weights in fed:
                raise ExportError(
                    f"the NIR node {weights} feeds the spiking nodes {fed[weights]} and {name}, expected one; "
                    "give each of them weights of its own"
                )
            fed[weights] = name
    if not fed:
        known = ", ".join(kind.__name__ for kind in _SPIKING)
        raise ExportError(f"the NIR graph has no spiking node, expected one of {known}; nothing can be counted")
    layers = []
    for name in interpreter.order:
        if isinstance(nodes[name], _SYNAPTIC):
            synapses, source = _synapses(interpreter, name, inputs)
            node = synapses.node
            neurons = NeuronCounter(fed[name], node.output_shape, inputs.timesteps) if name in fed else None
            of_each = states[fed[name]] if name in fed else 1
            layers.append(_Layer(SynapseCounter(synapses), source, node.outputs, fed.get(name), neurons, of_each))
    return layers


def _feeding(interpreter: NirInterpreter, spiking: str) -> tuple[str, int]:
    """The node with weights whose output drives a spiking node, the first in forward order if several do; and the
    state variables of one neuron."""
    found: set[str] = set()
    seen, to_do = {spiking}, [spiking]
    while to_do:
        for source in interpreter.sources[to_do.pop()]:
            node = interpreter.graph.nodes[source]
            if isinstance(node, _SYNAPTIC):
                found.add(source)
            elif source not in seen and not isinstance(node, _SPIKING):
                seen.add(source)
                to_do.append(source)
    if not found:
        raise ExportError(f"no weights lead to the NIR node {spiking}, expected a Conv2d, Affine or Linear before it")
    states = sum(_STATES.get(type(interpreter.graph.nodes[name]), 0) for name in seen)
    return min(found, key=interpreter.order.index), states


def _synapses(interpreter: NirInterpreter, name: str, inputs: _Inputs) -> tuple[CountedSynapses, str]:
    """A node's synapses, and the node that it hears through Flatten."""
    nodes, source = interpreter.graph.nodes, name
    while source == name or isinstance(nodes[source], nir.Flatten):
        sources = interpreter.sources[source]
        if len(sources) != 1:
            raise ExportError(f"the NIR node {source} adds up {', '.join(sources)}, expected one source before weights")
        (source,) = sources
    spikes_in = inputs.spikes if source == interpreter.input else isinstance(nodes[source], _SPIKING)
    return CountedSynapses(_described(interpreter, name), spikes_in), source


def _described(interpreter: NirInterpreter, name: str) -> Conv | Dense:
    """A node with weights as this package describes it; counting has no use for its bias."""
    node = interpreter.graph.nodes[name]
    nothing = np.zeros((1, len(node.weight)))
    facts: dict[str, Any] = {
        "name": name,
        "weight": node.weight,
        "scale_KO": nothing + 1.0,
        "shift_KO": nothing,
        "input_shape": _sides(node.input_type["input"]),
        "output_shape": _outputs(interpreter, name),
    }
    if name not in interpreter.geometry:
        return Dense(**facts)
    stride, padding = interpreter.geometry[name]
    return Conv(**facts, stride=stride, padding=padding)


def _outputs(interpreter: NirInterpreter, name: str) -> tuple[int, ...]:
    """Shape of what a node with weights computes at a step."""
    node = interpreter.graph.nodes[name]
    stated = _sides(node.output_type["output"])
    if name not in interpreter.geometry:
        return stated
    image, kernel = _sides(node.input_type["input"])[1:], node.weight.shape[2:]
    computed = (len(node.weight), *convolved_sides(image, kernel, *interpreter.geometry[name]))
    if computed != stated or min(computed) < 1:  # nir 1.0.8 takes every kernel for a square
        raise ExportError(
            f"the NIR node {name} has output shape {list(stated)}, expected {list(computed)} of a kernel of "
            f"{kernel[0]} x {kernel[1]} on {image[0]} x {image[1]}; NIR files need square kernels that fit the image"
        )
    return computed


def _checked(metadata: dict[str, Any]) -> dict[str, Any]:
    """The metadata that this package writes, its numbers as such.

    Raises:
        ExportError: one is no number, or the shape of an observation is no shape.
    """
    facts = dict(metadata)
    for key, kind in _NUMBERS.items():
        if key in facts:
            try:
                facts[key] = kind(np.asarray(facts[key]).item())
            except (TypeError, ValueError, OverflowError) as error:
                raise ExportError(
                    f"the NIR graph's {key} is {shown(facts[key])}, expected one number; export again"
                ) from error
    sides = np.asarray(facts["observation_shape"])
    if sides.ndim != 1 or sides.dtype.kind not in "iu":
        raise ExportError(
            f"the NIR graph's observation_shape is {shown(facts['observation_shape'])}, expected whole numbers; "
            "export again"
        )
    return facts


def _raw(observations: Array, facts: dict[str, Any]) -> _Inputs:
    """Raw observations ``[N, *shape]``, encoded as the network was trained; chunk by chunk, seeds 0, 1, 2, ..."""
    expected = _sides(facts["observation_shape"])
    if observations.shape[1:] != expected or len(observations) == 0:
        raise ExportError(
            f"observations has shape {_shape(observations.shape)}, expected {_shape(('N', *expected))} with N >= 1; "
            "record them with the network of this file"
        )
    if facts["scale"] < 1 and observations.dtype.kind == "f":
        raise ExportError(
            f"observations holds {observations.dtype} values, expected raw integers (the graph scales them by "
            f"{facts['scale']:.4g}); store them as they were seen"
        )
    encoding, timesteps, scale = str(facts["encoding"]), facts["timesteps"], facts["scale"]
    if encoding not in ENCODINGS:  # a file may not name code to import
        raise ExportError(
            f"the NIR graph's encoding is {encoding!r}, expected one of {', '.join(ENCODINGS)}; store encoded inputs "
            "as 'inputs' instead"
        )
    if encoding == "events" and "event_threshold" not in facts:
        raise ExportError("the NIR graph's metadata has no event_threshold, expected it for events; export again")
    threshold = facts.get("event_threshold", NetworkConfig.event_threshold)
    settings = NetworkConfig(encoding=cast(Any, encoding), timesteps=timesteps, event_threshold=threshold)
    # Whether the values suit the encoding was checked when the network was built.
    encoder = make_encoding(settings, facts["frame_stack"], in_unit_range=True)

    def batches() -> Iterator[Float]:
        for seed, chunk in enumerate(chunks(observations)):
            scaled = torch.from_numpy(chunk).to(torch.float32) * scale
            encoded: Float = encoder(scaled, torch.Generator().manual_seed(seed)).numpy()
            yield np.broadcast_to(encoded, (timesteps, *encoded.shape[1:]))

    return _Inputs(len(observations), timesteps, encoder.makes_spikes, encoder.constant_over_time, batches())


def _encoded(inputs: Array, shape: tuple[int, ...], facts: dict[str, Any]) -> _Inputs:
    """Inputs ``[T, N, *shape]`` as they are; ``facts`` is empty for a graph of somebody else."""
    steps = facts["timesteps"] if facts else inputs.shape[0] if inputs.ndim else 0
    if inputs.ndim != 2 + len(shape) or inputs.shape[2:] != shape or 0 in inputs.shape or len(inputs) != steps:
        expected = _shape((steps if facts else "T", "N", *shape))
        raise ExportError(
            f"inputs has shape {_shape(inputs.shape)}, expected {expected} with T and N >= 1: the graph's Input at "
            "every simulation step"
        )
    encoding = ENCODINGS.get(str(facts.get("encoding")))  # None: of somebody else
    spikes = bool(((inputs == 0) | (inputs == 1)).all()) and (encoding is None or encoding.makes_spikes)
    once = encoding is not None and encoding.constant_over_time and bool((inputs == inputs[:1]).all())
    batches = (inputs[:, part].astype(np.float32) for part in chunks(np.arange(inputs.shape[1])))
    return _Inputs(inputs.shape[1], len(inputs), spikes, once, batches)


def _arrays(path: Path) -> dict[str, Array]:
    """``observations`` or ``inputs``, and ``dt`` if it is there, from an ``.npz``."""
    keys = ("observations", "inputs", "dt")
    stored = read_npz(path, keys, "an .npz file with 'observations' or 'inputs'")
    if ("observations" in stored) == ("inputs" in stored):
        raise ExportError(
            f"{path} holds {' and '.join(stored)}, expected either 'observations' (raw, [N, ...]) "
            "or 'inputs' (encoded, [T, N, ...])"
        )
    return stored


def _dt(graph: nir.NIRGraph, stored: dict[str, Array]) -> float:
    """Length of a simulation step: the ``.npz``'s, else the graph's."""
    dt = stored.get("dt", graph.metadata.get("dt"))
    if dt is None:
        raise ExportError(
            "neither the NIR graph's metadata nor the .npz file has dt, expected the length of a simulation step; "
            "store it beside the inputs as 'dt'"
        )
    if np.size(dt) != 1 or not np.all(np.asarray(dt) > 0):
        raise ExportError(f"dt is {np.asarray(dt).tolist()}, expected one number above 0")
    return float(np.ravel(dt)[0])


def _sides(shape: npt.ArrayLike) -> tuple[int, ...]:
    return tuple(int(side) for side in np.asarray(shape))


def _shape(sides: tuple[Any, ...]) -> str:
    return f"[{', '.join(map(str, sides))}]"
