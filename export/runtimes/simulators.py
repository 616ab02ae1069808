"""Other people's simulators that read NIR files, where they are installed (extra: simulators; sinabs by hand).

Each runs T steps on encoded inputs and returns the graph's output per step. It says which neurons it runs in which
dialect, and what the reference interpreter must be told to agree bitwise. docs/deploy.md has all of it as one table.
"""

from __future__ import annotations

import importlib.util
import io
import logging
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from typing import Any, cast

import nir
import numpy as np
import torch

from switchmt_snn.export.runtimes.nir_interpreter import Float

_importing = threading.Lock()
"""Simulators run in threads and share packages (matplotlib) that fail when two threads import them at once."""


@dataclass(frozen=True)
class Simulator:
    """A simulator and how it reads a network's neurons.

    Attributes:
        modules: what must be importable.
        convention: in words, for reports.
        neurons: NIR nodes that it runs as NIR defines them, up to the convention.
        dialects: that it reads (``switchmt_snn.export.formats.nir_writer``).
        run: ``(graph, inputs_TB, dt) -> outputs_TB``.
        interpreter: the matching options of ``NirInterpreter``, beside the reset of the graph's metadata.
        one_tau: whether it computes something else, without a word, where the neurons of a layer have several tau.
    """

    modules: tuple[str, ...]
    convention: str
    neurons: tuple[type[nir.NIRNode], ...]
    dialects: tuple[str, ...]
    run: Callable[[nir.NIRGraph, Float, float], Float]
    interpreter: dict[str, Any] = field(default_factory=dict)
    one_tau: bool = False

    @property
    def missing(self) -> tuple[str, ...]:
        """The modules that cannot be found."""
        return tuple(name for name in self.modules if importlib.util.find_spec(name) is None)

    @property
    def installed(self) -> bool:
        """Whether it can be imported."""
        return not self.missing


def _norse(graph: nir.NIRGraph, inputs_TB: Float, dt: float) -> Float:
    """Unbatched, as its Flatten(0, -1) asks for: one observation after the other."""
    with _importing:
        import norse.torch

    network = norse.torch.from_nir(graph, ignore_warnings=True, dt=dt)
    return _one_by_one(lambda x, state: network(x, state), inputs_TB)


def _nirtorch(graph: nir.NIRGraph, inputs_TB: Float, dt: float) -> Float:
    """nirtorch with maps of our own: its default ones replace biases by random numbers (2.6)."""
    with _importing:
        import nirtorch

    maps: dict[type[nir.NIRNode], Callable[[Any], torch.nn.Module]] = {
        nir.Affine: _affine,
        nir.Flatten: lambda node: torch.nn.Flatten(0, -1),
        nir.Conv2d: _conv2d,
        nir.Scale: lambda node: _Stateless(node.scale, torch.mul),
        nir.Threshold: lambda node: _Stateless(node.threshold, lambda x, threshold: (x > threshold).to(x.dtype)),
        **dict.fromkeys((nir.IF, nir.LIF, nir.I, nir.LI), _Membrane),
    }
    network = nirtorch.nir_to_torch(graph, maps)
    return _one_by_one(lambda x, state: network(x, state), inputs_TB)


def _spikingjelly(graph: nir.NIRGraph, inputs_TB: Float, dt: float) -> Float:
    with _importing:
        from spikingjelly.activation_based.nir_exchange import import_from_nir

    network = import_from_nir(graph, dt=dt)
    state, outputs = None, []
    with torch.no_grad():
        for x in inputs_TB:
            y, state = network(torch.from_numpy(x), state)
            outputs.append(y.numpy())
    return np.stack(outputs)


def _sinabs(graph: nir.NIRGraph, inputs_TB: Float, dt: float) -> Float:
    with _importing:
        import sinabs.activation
        import sinabs.layers
        import sinabs.nir

    steps, batch = inputs_TB.shape[:2]
    network = sinabs.nir.from_nir(graph, batch_size=batch)
    for layer in network.modules():
        if isinstance(layer, sinabs.layers.IAFSqueeze):
            layer.spike_fn, layer.min_v_mem = sinabs.activation.SingleSpike, None
            if graph.metadata["reset"] == "zero":
                layer.reset_fn = sinabs.activation.MembraneReset()
    with torch.no_grad():
        y = network(torch.from_numpy(inputs_TB.swapaxes(0, 1).reshape(-1, *inputs_TB.shape[2:])))
    y = y[0] if isinstance(y, tuple) else y
    outputs: Float = y.numpy().reshape(batch, steps, -1).swapaxes(0, 1)
    return outputs


def _snntorch(graph: nir.NIRGraph, inputs_TB: Float, dt: float) -> Float:
    """Unbatched, as its Flatten(0, -1) asks for; its importer takes dt to be 1e-4, and its neurons keep their state."""
    with _importing:
        import snntorch
        from snntorch.import_nir import import_from_nir

    network = import_from_nir(graph)

    def step(x: torch.Tensor, state: Any) -> tuple[torch.Tensor, Any]:
        if state is None:
            for neuron in network.modules():
                if isinstance(neuron, snntorch.Leaky):
                    neuron.mem = torch.zeros(0)
        return cast(tuple[torch.Tensor, Any], network(x, state))

    return _one_by_one(step, inputs_TB)


_NOT_RESET_AT_ONCE = (nir.I, nir.LI, nir.Threshold, nir.Scale)
"""Nodes of the loops that reset by subtraction."""
_ABOVE, _AT = "fires at v > threshold", "fires at v >= threshold"

SIMULATORS: dict[str, Simulator] = {
    "norse": Simulator(("norse", "nirtorch"), f"reset to zero, {_ABOVE}", (nir.IF, nir.LIF), ("portable",), _norse),
    "nirtorch": Simulator(
        ("nirtorch",),
        f"own maps: as NIR says, {_ABOVE}",
        (nir.IF, nir.LIF, *_NOT_RESET_AT_ONCE),
        ("portable", "exact"),
        _nirtorch,
    ),
    "spikingjelly": Simulator(
        ("spikingjelly",),
        f"reset to zero, {_AT}",
        (nir.IF, nir.LIF),
        ("portable", "spikingjelly"),
        _spikingjelly,
        {"fires_at_threshold": True},
    ),
    "sinabs": Simulator(
        ("sinabs", "pbr"),
        f"SingleSpike, MembraneReset unless the network subtracts, no min_v_mem: {_AT}",
        (nir.IF,),
        ("portable", "legacy"),
        _sinabs,
        {"fires_at_threshold": True},
    ),
    "snntorch": Simulator(
        ("snntorch", "nirtorch"), f"reset to zero, {_ABOVE}", (nir.LIF,), ("spikingjelly",), _snntorch, one_tau=True
    ),
}
"""Simulators that are known to run a network exactly, up to their conventions."""


_COMMON = (nir.Input, nir.Conv2d, nir.Flatten, nir.Affine, nir.Output)
"""Nodes that all of them run as NIR defines them."""


def skipped(name: str, graph: nir.NIRGraph) -> str | None:
    """Why a simulator is not compared on a graph; None if it is."""
    simulator, dialect = SIMULATORS[name], str(graph.metadata["profile"])
    if simulator.missing:
        return f"{', '.join(simulator.missing)} not installed"
    if dialect not in simulator.dialects:
        return f"does not take the dialect {dialect}, only {', '.join(simulator.dialects)}"
    known = (*_COMMON, *simulator.neurons)
    others = sorted({type(node).__name__ for node in graph.nodes.values() if not isinstance(node, known)})
    if others:
        return f"refuses {', '.join(others)}, or computes something else"
    leaky = [node for node in graph.nodes.values() if isinstance(node, nir.LIF)]
    if simulator.one_tau and any(np.unique(node.tau).size > 1 for node in leaky):
        return "scales every threshold of a layer by one tau, and this network has several in a layer (learned beta)"
    return None


def simulate(name: str, graph: nir.NIRGraph, inputs_TB: Float) -> Float:
    """Outputs ``[T, B, ...]`` of a graph in a simulator, on encoded inputs ``[T, B, ...]``."""
    return SIMULATORS[name].run(graph, np.ascontiguousarray(inputs_TB), float(graph.metadata["dt"]))


@contextmanager
def quietly() -> Iterator[None]:
    """Without what the simulators say (outside of threads: filters and streams belong to the process)."""
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        logging.getLogger("torch").setLevel(logging.ERROR)
        yield


def _one_by_one(step: Callable[[torch.Tensor, Any], tuple[torch.Tensor, Any]], inputs_TB: Float) -> Float:
    outputs = []
    with torch.no_grad():
        for inputs_T in inputs_TB.swapaxes(0, 1):
            state, values = None, []
            for x in inputs_T:
                y, state = step(torch.from_numpy(np.ascontiguousarray(x)), state)
                values.append(y.numpy())
            outputs.append(np.stack(values))
    return np.stack(outputs, axis=1)


def _affine(node: nir.Affine) -> torch.nn.Module:
    linear = torch.nn.Linear(node.weight.shape[1], node.weight.shape[0])
    return _with_weights(linear, node)


def _conv2d(node: nir.Conv2d) -> torch.nn.Module:
    out, channels, kh, kw = node.weight.shape
    stride = int(np.ravel(node.stride)[0])
    return _with_weights(torch.nn.Conv2d(channels, out, (kh, kw), stride), node)


def _with_weights(module: torch.nn.Module, node: Any) -> torch.nn.Module:
    module.load_state_dict({"weight": torch.from_numpy(node.weight), "bias": torch.from_numpy(node.bias)})
    return module


class _Stateless(torch.nn.Module):
    """A function of the input and of one parameter."""

    def __init__(self, parameter: Float, function: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> None:
        super().__init__()
        self.parameter, self.function = torch.from_numpy(parameter), function

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.function(x, self.parameter)


class _Membrane(torch.nn.Module):
    """nir.IF, LIF, I and LI as NIR defines them, with dt = 1 and no leak potential."""

    def __init__(self, node: Any) -> None:
        super().__init__()
        self.leaky, self.spiking = isinstance(node, (nir.LIF, nir.LI)), isinstance(node, (nir.IF, nir.LIF))
        self.r = torch.from_numpy(node.r)
        self.rate = 1.0 / torch.from_numpy(node.tau) if self.leaky else self.r
        self.threshold = torch.from_numpy(node.v_threshold) if self.spiking else None

    def forward(self, x: torch.Tensor, state: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        v = torch.zeros_like(x) if state is None else state
        v = v + self.rate * (self.r * x - v if self.leaky else x)
        if self.threshold is None:
            return v, v
        fired = v > self.threshold
        return fired.to(x.dtype), torch.where(fired, torch.zeros_like(v), v)
