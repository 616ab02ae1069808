"""A reference interpreter of NIR graphs in NumPy, to be read in one sitting.

Each node is advanced by explicit Euler steps of length ``dt`` in float32. A signal passes all nodes within one step,
except along an edge that closes a loop, which carries the value of the step before (zero at the first).

Shapes: T simulation steps, B batch, ... a node's own shape. NIR has neither a time nor a batch axis; here they lead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import nir
import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import ExportError

Float = npt.NDArray[np.float32]
Step = Callable[[Float], Float]


class NirInterpreter:
    """A NIR graph that runs.

    Args:
        graph: one Input, one Output; nodes Conv2d, Affine, Linear, Flatten, IF, LIF, I, LI, Threshold, Scale.
        dt: length of a simulation step; None takes it from the graph's metadata.
        reset: what a spike does to the membrane of IF and LIF nodes: ``zero`` (to v_reset, as NIR defines it) or
            ``subtract`` (the threshold, as sinabs does).
        fires_at_threshold: whether v == threshold fires (``>=``); NIR defines ``>``.
        floor: whether membranes stay at or above minus the threshold (sinabs); NIR has no floor.

    Raises:
        ExportError: the graph has nodes or a structure that is not known here.
    """

    def __init__(
        self,
        graph: nir.NIRGraph,
        dt: float | None = None,
        reset: str = "zero",
        fires_at_threshold: bool = False,
        floor: bool = False,
    ) -> None:
        if dt is None:
            if "dt" not in graph.metadata:
                raise ExportError("the NIR graph's metadata has no dt, expected the length of a step; pass dt")
            dt = float(graph.metadata["dt"])
        self.graph, self.dt, self.reset, self.floor = graph, dt, reset, floor
        self._fires = np.greater_equal if fires_at_threshold else np.greater
        self.order, self.feedback = _topological_order(graph)
        (self.input,) = [name for name, node in graph.nodes.items() if isinstance(node, nir.Input)]
        (self.output,) = [name for name, node in graph.nodes.items() if isinstance(node, nir.Output)]
        unknown = {type(node).__name__ for node in graph.nodes.values()} - {*_KNOWN, "Input", "Output"}
        if unknown:
            raise ExportError(f"the NIR graph has {', '.join(sorted(unknown))}, expected only {', '.join(_KNOWN)}")

    def run(self, inputs_TB: Float, record: list[str] | None = None) -> tuple[Float, dict[str, Float]]:
        """Simulate T steps from rest.

        Args:
            inputs_TB: encoded inputs ``[T, B, ...]``.
            record: names of nodes whose outputs to keep.

        Returns:
            The output node's values ``[T, B, ...]``, and the recorded ones by name.
        """
        steps: dict[str, Step] = {
            name: self._stepper(node) for name, node in self.graph.nodes.items() if type(node).__name__ in _KNOWN
        }
        sources: dict[str, list[str]] = {name: [] for name in self.graph.nodes}
        for source, target in self.graph.edges:
            sources[target].append(source)
        kept: dict[str, list[Float]] = {name: [] for name in {*(record or []), self.output}}
        before: dict[str, Float] = {}
        same_input = inputs_TB.strides[0] == 0  # direct encoding: one array, seen T times
        for step in range(len(inputs_TB)):
            now: dict[str, Float] = {self.input: inputs_TB[0] if same_input else inputs_TB[step]}
            if same_input and before:
                now[self.input] = before[self.input]
            for name in self.order:
                if name == self.input:
                    continue
                arriving = [
                    before.get(source) if (source, name) in self.feedback else now[source] for source in sources[name]
                ]
                present = [value for value in arriving if value is not None]
                total = present[0] if len(present) == 1 else cast(Float, sum(present))
                now[name] = total if name == self.output else steps[name](total)
            for name, values in kept.items():
                values.append(now[name])
            before = now
        recorded = {name: np.stack(values) for name, values in kept.items()}
        return recorded[self.output], recorded

    def _stepper(self, node: nir.NIRNode) -> Step:
        """A fresh node at rest: input of one step ``[B, ...]`` -> output of that step."""
        if isinstance(node, nir.Conv2d):
            return _once(lambda x: _convolve(x, node))
        if isinstance(node, nir.Affine):
            return _once(lambda x: cast(Float, x @ node.weight.T + node.bias))
        if isinstance(node, nir.Linear):
            return lambda x: cast(Float, x @ node.weight.T)
        if isinstance(node, nir.Flatten):
            return lambda x: x.reshape(len(x), -1)
        if isinstance(node, nir.Scale):
            return lambda x: cast(Float, x * node.scale)
        if isinstance(node, nir.Threshold):
            return lambda x: self._fires(x, node.threshold).astype(np.float32)
        return _Membrane(node, self.dt, self.reset, self._fires, self.floor)


def _once(stateless: Step) -> Step:
    """Do not compute the same array's output again."""
    seen: list[Float] = []

    def step(x: Float) -> Float:
        if not seen or seen[0] is not x:
            seen[:] = [x, stateless(x)]
        return seen[1]

    return step


_KNOWN = ("Conv2d", "Affine", "Linear", "Flatten", "IF", "LIF", "I", "LI", "Threshold", "Scale")


class _Membrane:
    """IF: v' = r x. LIF: tau v' = v_leak - v + r x. Both fire and reset; I and LI only integrate."""

    def __init__(self, node: Any, dt: float, reset: str, fires: Callable[..., Any], floor: bool) -> None:
        self.node, self.reset, self.fires, self.floor = node, reset, fires, floor
        self.leaky = isinstance(node, (nir.LIF, nir.LI))
        self.spiking = isinstance(node, (nir.IF, nir.LIF))
        # dt r (or dt / tau) is one number per neuron; multiplied in float64, so that dt = 1 / r is exactly 1.
        rate = dt / node.tau.astype(np.float64) if self.leaky else dt * node.r.astype(np.float64)
        self.rate = rate.astype(np.float32)
        self.v: Float | None = None

    def __call__(self, x: Float) -> Float:
        v = np.zeros_like(x) if self.v is None else self.v
        change = (self.node.v_leak - v) + self.node.r * x if self.leaky else x
        v = v + self.rate * change
        if not self.spiking:
            self.v = v
            return cast(Float, v)
        fired = self.fires(v, self.node.v_threshold)
        after = v - self.node.v_threshold if self.reset == "subtract" else np.broadcast_to(self.node.v_reset, v.shape)
        v = np.where(fired, after, v)
        self.v = np.maximum(v, -self.node.v_threshold) if self.floor else v
        return cast(Float, fired.astype(np.float32))


def _convolve(x: Float, node: nir.Conv2d) -> Float:
    """Cross-correlation without padding, dilation or groups: all windows times all kernels."""
    (out, _, kh, kw), stride = node.weight.shape, int(np.ravel(node.stride)[0])
    windows = np.lib.stride_tricks.sliding_window_view(x, (kh, kw), axis=(2, 3))[:, :, ::stride, ::stride]
    batch, _, height, width = windows.shape[:4]
    # Channels innermost: the windows' rows are then contiguous in the output of a layer before, and quick to gather.
    columns = windows.transpose(0, 2, 3, 4, 5, 1).reshape(batch * height * width, -1)
    y = columns @ node.weight.transpose(0, 2, 3, 1).reshape(out, -1).T + node.bias
    return cast(Float, y.reshape(batch, height, width, out).transpose(0, 3, 1, 2))


def _topological_order(graph: nir.NIRGraph) -> tuple[list[str], set[tuple[str, str]]]:
    """Nodes from Input on, and the edges that close a loop (found depth first)."""
    following: dict[str, list[str]] = {name: [] for name in graph.nodes}
    for source, target in graph.edges:
        following[source].append(target)
    order: list[str] = []
    feedback: set[tuple[str, str]] = set()
    state: dict[str, str] = {}

    def visit(name: str) -> None:
        state[name] = "open"
        for target in following[name]:
            if state.get(target) == "open":
                feedback.add((name, target))
            elif target not in state:
                visit(target)
        state[name] = "done"
        order.append(name)

    for name, node in graph.nodes.items():
        if isinstance(node, nir.Input):
            visit(name)
    return order[::-1], feedback
