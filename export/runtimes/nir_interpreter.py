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
from switchmt_snn.export.runtimes.nir_shapes import MOST_NODES, signal_shapes

Float = npt.NDArray[np.float32]
Step = Callable[[Float], Float]
Pair = tuple[int, int]
"""Vertical and horizontal."""
RESETS = ("zero", "subtract", "subtract_after_decay")
"""What a spike does to its membrane.

========================  ==========================================================================================
``zero``                  sets it to v_reset, as NIR defines it
``subtract``              subtracts the threshold at once, so that what is left decays from the next step on (sinabs)
``subtract_after_decay``  subtracts the threshold in the next step, after the decay (snnTorch's default)
========================  ==========================================================================================

Without a decay the two subtractions are the same.
"""


class NirInterpreter:
    """A NIR graph that runs.

    Args:
        graph: one Input, one Output; nodes Conv2d, Affine, Linear, Flatten, IF, LIF, CubaLIF, I, LI, Threshold,
            Scale.
        dt: length of a simulation step; None takes it from the graph's metadata.
        reset: what a spike does to the membrane of IF, LIF and CubaLIF nodes, one of ``RESETS``.
        fires_at_threshold: whether v == threshold fires (``>=``); NIR defines ``>``.
        floor: whether membranes stay at or above minus the threshold (sinabs); NIR has no floor.

    Attributes:
        order: names of the nodes in forward order.
        sources: names of the nodes whose outputs each node receives; their sum is its input.
        geometry: stride and zero padding of each Conv2d node.
        shapes: of each node's output, without the batch.

    Raises:
        ExportError: the graph has nodes or a structure that is not known here, or there is no such reset.
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
            dt = _length(graph.metadata["dt"])
        if reset not in RESETS:
            raise ExportError(f"the reset of NIR neurons is {reset!r}, expected one of {', '.join(RESETS)}")
        self.graph, self.dt, self.reset, self.floor = graph, dt, reset, floor
        self._fires = np.greater_equal if fires_at_threshold else np.greater
        unknown = {type(node).__name__ for node in graph.nodes.values()} - {*_KNOWN, "Input", "Output"}
        if unknown:
            raise ExportError(f"the NIR graph has {', '.join(sorted(unknown))}, expected only {', '.join(_KNOWN)}")
        if len(graph.nodes) > MOST_NODES:
            raise ExportError(f"the NIR graph has {len(graph.nodes):,} nodes, expected at most {MOST_NODES}")
        for name, node in graph.nodes.items():
            _check_shape(name, node)
        self.input, self.output = _only(graph, nir.Input), _only(graph, nir.Output)
        self.order, self.feedback = _topological_order(graph)
        apart = sorted(graph.nodes.keys() - set(self.order))
        if apart:
            raise ExportError(
                f"no path leads from the NIR graph's Input to {', '.join(apart)}, expected one to each node"
            )
        self.sources: dict[str, list[str]] = {name: [] for name in graph.nodes}
        for source, target in graph.edges:
            self.sources[target].append(source)
        self.geometry = {
            name: _geometry(name, node) for name, node in graph.nodes.items() if isinstance(node, nir.Conv2d)
        }
        self.shapes = signal_shapes(graph, self.order, self.sources, self.feedback, self.geometry)

    def run(self, inputs_TB: Float, record: list[str] | None = None) -> tuple[Float, dict[str, Float]]:
        """Simulate T steps from rest.

        Args:
            inputs_TB: encoded inputs ``[T, B, ...]``.
            record: names of nodes whose outputs to keep.

        Returns:
            The output node's values ``[T, B, ...]``, and the recorded ones by name.

        Raises:
            ExportError: the inputs have another shape than the Input node.
        """
        if inputs_TB.shape[2:] != self.shapes[self.input]:
            raise ExportError(
                f"the NIR graph's Input has the shape {self.shapes[self.input]}, expected {inputs_TB.shape[2:]} as "
                "it is given; export the run again"
            )
        steps: dict[str, Step] = {
            name: self._stepper(name, node) for name, node in self.graph.nodes.items() if type(node).__name__ in _KNOWN
        }
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
                    before.get(source) if (source, name) in self.feedback else now[source]
                    for source in self.sources[name]
                ]
                present = [value for value in arriving if value is not None]
                total = present[0] if len(present) == 1 else cast(Float, sum(present))
                now[name] = total if name == self.output else steps[name](total)
            for name, values in kept.items():
                values.append(now[name])
            before = now
        recorded = {name: np.stack(values) for name, values in kept.items()}
        return recorded[self.output], recorded

    def _stepper(self, name: str, node: nir.NIRNode) -> Step:
        """A fresh node at rest: input of one step ``[B, ...]`` -> output of that step."""
        if isinstance(node, nir.Conv2d):
            return _once(lambda x: _convolve(x, node, *self.geometry[name]))
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
        if isinstance(node, nir.CubaLIF):
            return _Cuba(node, self.dt, self.reset, self._fires, self.floor)
        return _Membrane(node, self.dt, self.reset, self._fires, self.floor)


def _once(stateless: Step) -> Step:
    """Do not compute the same array's output again."""
    seen: list[Float] = []

    def step(x: Float) -> Float:
        if not seen or seen[0] is not x:
            seen[:] = [x, stateless(x)]
        return seen[1]

    return step


_KNOWN = ("Conv2d", "Affine", "Linear", "Flatten", "IF", "LIF", "CubaLIF", "I", "LI", "Threshold", "Scale")


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
        self.owed: Float | None = None
        """What the spikes of the last step take off after the decay."""

    def __call__(self, x: Float) -> Float:
        v = np.zeros_like(x) if self.v is None else self.v
        change = (self.node.v_leak - v) + self.node.r * x if self.leaky else x
        v = v + self.rate * change
        if not self.spiking:
            self.v = v
            return cast(Float, v)
        if self.owed is not None:
            v = v - self.owed
        fired = self.fires(v, self.node.v_threshold)
        if self.reset == "subtract_after_decay":
            self.owed = fired * self.node.v_threshold
        else:
            v = np.where(fired, v - self.node.v_threshold if self.reset == "subtract" else self.node.v_reset, v)
        self.v = np.maximum(v, -self.node.v_threshold) if self.floor else v
        return cast(Float, fired.astype(np.float32))


class _Cuba:
    """CubaLIF: tau_syn I' = w_in x - I, then the LIF that I drives, which sees I of the same step."""

    def __init__(self, node: nir.CubaLIF, dt: float, reset: str, fires: Callable[..., Any], floor: bool) -> None:
        self.weight, rate = node.w_in, dt / node.tau_syn.astype(np.float64)
        self.rate = rate.astype(np.float32)
        driven = nir.LIF(
            tau=node.tau_mem, r=node.r, v_leak=node.v_leak, v_threshold=node.v_threshold, v_reset=node.v_reset
        )
        self.membrane = _Membrane(driven, dt, reset, fires, floor)
        self.current: Float | None = None

    def __call__(self, x: Float) -> Float:
        current = np.zeros_like(x) if self.current is None else self.current
        self.current = current + self.rate * (self.weight * x - current)
        return self.membrane(self.current)


def _convolve(x: Float, node: nir.Conv2d, stride: Pair, padding: Pair) -> Float:
    """Cross-correlation without dilation or groups: all windows times all kernels."""
    (out, _, kh, kw), (sy, sx) = node.weight.shape, stride
    windows = np.lib.stride_tricks.sliding_window_view(_padded(x, padding), (kh, kw), axis=(2, 3))[:, :, ::sy, ::sx]
    batch, _, height, width = windows.shape[:4]
    # Channels innermost: the windows' rows are then contiguous in the output of a layer before, and quick to gather.
    columns = windows.transpose(0, 2, 3, 4, 5, 1).reshape(batch * height * width, -1)
    y = columns @ node.weight.transpose(0, 2, 3, 1).reshape(out, -1).T + node.bias
    return cast(Float, y.reshape(batch, height, width, out).transpose(0, 3, 1, 2))


def _padded(x: Float, padding: Pair) -> Float:
    """Zeros around images ``[B, C, H, W]``; channels stay innermost in memory."""
    if padding == (0, 0):
        return x
    (batch, channels, height, width), (py, px) = x.shape, padding
    around = np.zeros((batch, height + 2 * py, width + 2 * px, channels), np.float32).transpose(0, 3, 1, 2)
    around[:, :, py : py + height, px : px + width] = x
    return around


def _length(dt: Any) -> float:
    """Length of a step from a graph's metadata."""
    if np.size(dt) == 1 and np.asarray(dt).dtype.kind in "iuf" and 0 < np.ravel(dt)[0] < np.inf:
        return float(np.ravel(dt)[0])
    raise ExportError(f"the NIR graph's dt is {dt!s:.60}, expected one number above 0; export the run again")


def _check_shape(name: str, node: nir.NIRNode) -> None:
    """Refuse what NIR allows in shapes and the interpreter would get wrong."""
    for parameter in ("tau", "tau_syn", "tau_mem"):
        if not (np.asarray(getattr(node, parameter, 1.0)) > 0).all():
            raise ExportError(f"the NIR node {name} has a {parameter} of 0 or less, expected numbers above 0")
    if isinstance(node, (nir.Affine, nir.Linear)) and node.weight.ndim != 2:
        raise ExportError(f"the NIR node {name} has weights of shape {node.weight.shape}, expected (outputs, inputs)")
    if isinstance(node, nir.Flatten):
        flat = node.output_type["output"]
        if flat is not None and len(flat) != 1:
            raise ExportError(f"the NIR node {name} flattens to {_plain(flat)}, expected one dimension")


def _geometry(name: str, node: nir.Conv2d) -> tuple[Pair, Pair]:
    """Stride and padding of a convolution. NIR files hold them as a number, a pair or an array; padding also by name.

    Raises:
        ExportError: dilation, groups, or a padding that ``_convolve`` does not know.
    """
    for what in ("dilation", "groups"):
        value = getattr(node, what)
        if (np.ravel(value) != 1).any():
            raise ExportError(f"the NIR node {name} has {what} {_plain(value)!s:.60}, expected 1")
    stride = _pair(name, "stride", node.stride, 1)
    if not isinstance(node.padding, str) or node.padding not in ("valid", "same"):
        return stride, _pair(name, "padding", node.padding, 0)
    if node.padding == "valid":
        return stride, (0, 0)
    kh, kw = node.weight.shape[2:]
    if stride != (1, 1) or kh % 2 == 0 or kw % 2 == 0:  # the two sides of an image would be padded differently
        raise ExportError(
            f"the NIR node {name} has padding 'same' with stride {stride} and a kernel of {kh} x {kw}, expected stride "
            "1 and odd sides; write the padding as numbers"
        )
    return stride, (kh // 2, kw // 2)


def _pair(name: str, what: str, value: Any, least: int) -> Pair:
    pair = np.ravel(value)
    if pair.size not in (1, 2) or pair.dtype.kind not in "iu" or (pair < least).any():
        seen = f"{_plain(value)!s:.60}"
        raise ExportError(f"the NIR node {name} has {what} {seen}, expected one or two numbers >= {least}")
    return int(pair[0]), int(pair[-1])


def _plain(value: Any) -> Any:
    """A number or a list, whatever kind of array holds it."""
    return np.asarray(value).tolist()


def _only(graph: nir.NIRGraph, kind: type) -> str:
    """The name of the only node of a kind."""
    names: list[str] = [name for name, node in graph.nodes.items() if isinstance(node, kind)]
    if len(names) != 1:
        raise ExportError(f"the NIR graph has {len(names)} {kind.__name__} nodes, expected one")
    return names[0]


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
