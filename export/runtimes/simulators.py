"""Other people's simulators that read NIR files, where they are installed (extra: simulators; sinabs by hand).

Each runs T steps on encoded inputs and returns the graph's output per step; its convention says what the reference
interpreter must be told to agree bitwise.
"""

from __future__ import annotations

import importlib.util
import logging
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import nir
import numpy as np
import torch

from switchmt_snn.export.runtimes.nir_interpreter import Float

_importing = threading.Lock()
"""Simulators run in threads and share packages (matplotlib) that fail when two threads import them at once."""


@dataclass(frozen=True)
class Simulator:
    """A simulator and how it reads ``nir.IF``.

    Attributes:
        modules: what must be importable.
        convention: in words, for reports.
        interpreter: the matching options of ``NirInterpreter``.
        run: ``(graph, inputs_TB, dt) -> outputs_TB``.
    """

    modules: tuple[str, ...]
    convention: str
    run: Callable[[nir.NIRGraph, Float, float], Float]
    interpreter: dict[str, Any] = field(default_factory=dict)

    @property
    def installed(self) -> bool:
        """Whether it can be imported."""
        return all(importlib.util.find_spec(name) is not None for name in self.modules)


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
        nir.IF: _ImmediateResetIF,
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
            layer.spike_fn = sinabs.activation.SingleSpike
    with torch.no_grad():
        y = network(torch.from_numpy(inputs_TB.swapaxes(0, 1).reshape(-1, *inputs_TB.shape[2:])))
    y = y[0] if isinstance(y, tuple) else y
    outputs: Float = y.numpy().reshape(batch, steps, -1).swapaxes(0, 1)
    return outputs


SIMULATORS: dict[str, Simulator] = {
    "norse": Simulator(("norse", "nirtorch"), "reset to zero, fires at v > threshold", _norse),
    "nirtorch": Simulator(("nirtorch",), "own maps: reset to zero, fires at v > threshold", _nirtorch),
    "spikingjelly": Simulator(
        ("spikingjelly",),
        "reset to zero, fires at v >= threshold",
        _spikingjelly,
        {"fires_at_threshold": True},
    ),
    "sinabs": Simulator(
        ("sinabs", "pbr"),
        "SingleSpike: resets by subtraction, fires at v >= threshold, membrane not below -threshold",
        _sinabs,
        {"reset": "subtract", "fires_at_threshold": True, "floor": True},
    ),
}
"""Simulators that are known to read the portable profile."""


_COMPARED = (nir.Input, nir.Conv2d, nir.IF, nir.Flatten, nir.Affine, nir.Output)
"""Nodes on which the importers agree with NIR up to the conventions above."""


def skipped(name: str, graph: nir.NIRGraph) -> str | None:
    """Why a simulator is not compared on a graph; None if it is."""
    if not SIMULATORS[name].installed:
        return f"{', '.join(SIMULATORS[name].modules)} not installed"
    if str(graph.metadata["profile"]) in ("exact", "legacy"):
        return f"does not take the dialect {graph.metadata['profile']}"
    others = sorted({type(node).__name__ for node in graph.nodes.values() if not isinstance(node, _COMPARED)})
    if others:
        return f"importers differ in what {', '.join(others)} means"
    if name in ("norse", "nirtorch") and float(graph.metadata["dt"]) != 1.0:
        return f"takes dt 1, not {graph.metadata['dt']}"
    return None


def simulate(name: str, graph: nir.NIRGraph, inputs_TB: Float) -> Float:
    """Outputs ``[T, B, ...]`` of a graph in a simulator, on encoded inputs ``[T, B, ...]``."""
    return SIMULATORS[name].run(graph, np.ascontiguousarray(inputs_TB), float(graph.metadata["dt"]))


@contextmanager
def quietly() -> Iterator[None]:
    """Without the simulators' warnings (outside of threads: warning filters belong to the process)."""
    with warnings.catch_warnings():
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


class _ImmediateResetIF(torch.nn.Module):
    """nir.IF as NIR defines it, with dt r = 1."""

    def __init__(self, node: nir.IF) -> None:
        super().__init__()
        self.threshold = torch.from_numpy(node.v_threshold)

    def forward(self, x: torch.Tensor, state: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        v = x if state is None else state + x
        fired = v > self.threshold
        return fired.to(x.dtype), torch.where(fired, torch.zeros_like(v), v)
