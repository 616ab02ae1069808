"""The description of a network: one small class per node. Every reader (ONNX, NIR, counting, chips) dispatches on them.

===========  =========================================================================================
node         equation
===========  =========================================================================================
Conv         ``current = scale_KO[k] * (W * x) + shift_KO[k]``, ``*`` the cross-correlation of images
Dense        ``current = scale_KO[k] * (W x) + shift_KO[k]``, then k winners per group if it has them
TaskDense    ``current = scale_KO[k] * (W_k x) + shift_KO[k]``, a matrix of its own for each task k
ReadoutNode  Q-values from the head's outputs at the T steps
===========  =========================================================================================

The neuron models describe themselves as subclasses of ``NeuronNode``. A reader is a ``functools.singledispatch``
function over these classes. Its default raises ``ExportError`` with the node's name, so a reader never treats a
node that it does not know as one that it knows.

Shapes: O output channels or features, I input channels or features, K tasks, T simulation steps, B batch, A actions.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import ExportError

Array = npt.NDArray[np.float64]
Float = npt.NDArray[np.float32]
Pair = tuple[int, int]
"""Vertical and horizontal."""


def convolved_sides(sides: Sequence[int], kernel: Sequence[int], stride: Pair, padding: Pair = (0, 0)) -> Pair:
    """Height and width of a convolution's output for images of these sides."""
    height, width = (
        (side + 2 * pad - reach) // step + 1
        for side, reach, step, pad in zip(sides, kernel, stride, padding, strict=True)
    )
    return height, width


@dataclass(frozen=True, kw_only=True)
class SynapseNode:
    """What all synapses have: ``current = scale_KO[k] * (W x) + shift_KO[k]`` for task k.

    BatchNorm at inference and the gain of active dendrites are affine maps of output channels, so both are in the
    scale and the shift.

    Attributes:
        name: the layer's name: ``conv1`` ..., ``linear1``, ``hidden`` or ``head``.
        weight: float64, see the node.
        scale_KO: factor of each output channel by task.
        shift_KO: bias of each output channel by task, added after the factor.
        input_shape: ``(C, H, W)`` or ``(features,)``.
        output_shape: ``(O, H, W)`` or ``(O,)``.
        weight_steps_O: of quantized weights: weight = integer times this step, per output channel.
    """

    name: str
    weight: Array
    scale_KO: Array
    shift_KO: Array
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    weight_steps_O: Array | None = None

    @property
    def kind(self) -> str:
        """The kind of synapses in descriptions and errors (``Conv2d``, ``Linear``)."""
        raise NotImplementedError(f"{type(self).__name__} defines no kind, expected a property with a name")

    @property
    def depends_on_task(self) -> bool:
        """Whether tasks differ in scale or shift."""
        return bool((self.scale_KO != self.scale_KO[:1]).any() or (self.shift_KO != self.shift_KO[:1]).any())

    @property
    def outputs(self) -> int:
        """Values that it computes at a simulation step."""
        return math.prod(self.output_shape)

    @property
    def dense_operations(self) -> int:
        """Products of one pass in which every weight meets every input that it reaches; padding is not counted."""
        raise NotImplementedError(f"{type(self).__name__} defines no count of its operations, expected a number")

    def of_task(self, task: int) -> SynapseNode:
        """The synapses of a network that serves one task; other tasks' weights are left out."""
        return self

    def over_weight(self, values_O: Array) -> Array:
        """Values per output channel, shaped to broadcast over ``weight``."""
        return values_O.reshape(-1, *(1,) * (self.weight.ndim - 1))

    def folded(self, task: int) -> tuple[Float, Float]:
        """Weight and bias of one task, scale and shift multiplied in, as float32."""
        weight = self.weight * self.over_weight(self.scale_KO[task])
        return weight.astype(np.float32), self.shift_KO[task].astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Conv(SynapseNode):
    """Convolution with zero padding, without dilation or groups.

    ``y[o, i, j] = sum over c, a, b of weight[o, c, a, b] x[c, i sy + a - py, j sx + b - px]``, with stride (sy, sx),
    padding (py, px), and x zero outside of the image.

    Attributes:
        weight: ``[O, C, kh, kw]``.
        stride: (sy, sx).
        padding: (py, px).
    """

    stride: Pair
    padding: Pair = (0, 0)

    @property
    def kind(self) -> str:
        """``Conv2d``."""
        return "Conv2d"

    @property
    def dense_operations(self) -> int:
        """Every output channel meets every input channel; height and width are independent."""
        outputs, channels, *kernel = map(int, self.weight.shape)
        products = outputs * channels
        for side, reach, step, pad in zip(self.input_shape[1:], kernel, self.stride, self.padding, strict=True):
            starts = range(-pad, side + pad - reach + 1, step)
            products *= sum(max(0, min(start + reach, side) - max(start, 0)) for start in starts)
        return products


@dataclass(frozen=True, kw_only=True)
class Dense(SynapseNode):
    """Linear map ``y[o] = sum over i of weight[o, i] x[i]``; an image is flattened first.

    With k winners, only the k largest currents of each group are kept at each step; the others are 0.

    Attributes:
        weight: ``[O, I]``.
        groups: equal parts of the output that ``k_winners`` compares within (a dueling network has two).
        k_winners: currents kept per group and step, or None.
        gated: whether ``scale_KO`` holds the gains of active dendrites.
    """

    groups: int = 1
    k_winners: int | None = None
    gated: bool = False

    @property
    def kind(self) -> str:
        """``Linear``."""
        return "Linear"

    def of_task(self, task: int) -> Dense:
        """Itself: its weights serve all tasks."""
        return self

    @property
    def dense_operations(self) -> int:
        """Every weight meets one input."""
        return self.weight.size


@dataclass(frozen=True, kw_only=True)
class TaskDense(SynapseNode):
    """A linear map for each task, of which a decision computes one: ``y[o] = sum over i of weight[k O + o, i] x[i]``.

    Attributes:
        weight: ``[K * O, I]``, the rows of a task side by side; ``weight_steps_O`` has as many entries.
    """

    @property
    def kind(self) -> str:
        """``Linear per task``."""
        return "Linear per task"

    @property
    def depends_on_task(self) -> bool:
        """Always."""
        return True

    @property
    def dense_operations(self) -> int:
        """Every weight of a task meets one input."""
        return self.weight.size // len(self.shift_KO)

    def of_task(self, task: int) -> Dense:
        """A task's own rows."""
        rows = slice(task * self.outputs, (task + 1) * self.outputs)
        return Dense(
            name=self.name,
            weight=self.weight[rows],
            scale_KO=self.scale_KO,
            shift_KO=self.shift_KO,
            input_shape=self.input_shape,
            output_shape=self.output_shape,
            weight_steps_O=None if self.weight_steps_O is None else self.weight_steps_O[rows],
        )

    def folded(self, task: int) -> tuple[Float, Float]:
        """As that of the task's own rows."""
        return self.of_task(task).folded(task)


@dataclass(frozen=True)
class ReadoutNode:
    """Q-values from the head's outputs ``y(1) ... y(T)``.

    ============  ===========================================================
    kind          Q
    ============  ===========================================================
    mean          mean of ``y(t)`` over T
    last_membrane ``M(T)``, with ``M(t) = beta M(t-1) + y(t)``, ``M(0) = 0``
    max_membrane  largest ``M(t)``
    ============  ===========================================================

    Attributes:
        kind: ``mean``, ``last_membrane`` or ``max_membrane``.
        beta: decay of M per simulation step; ``mean`` has no use for it.
    """

    kind: str
    beta: float

    def __post_init__(self) -> None:
        """Refuse an unknown kind, so that no reader meets one.

        Raises:
            ExportError: an unknown kind.
        """
        known = ("mean", "last_membrane", "max_membrane")
        if self.kind not in known:
            raise ExportError(f"the readout is {self.kind!r}, expected one of {', '.join(known)}")

    def __call__(self, outputs_TBA: Float) -> Float:
        """Q ``[B, A]`` from the head's outputs ``[T, B, A]``."""
        if self.kind == "mean":
            return cast(Float, outputs_TBA.mean(axis=0))
        membranes = [outputs_TBA[0]]
        for output in outputs_TBA[1:]:
            membranes.append(np.float32(self.beta) * membranes[-1] + output)
        return cast(Float, membranes[-1] if self.kind == "last_membrane" else np.max(membranes, axis=0))


@dataclass(frozen=True)
class NeuronNode:
    """Neurons of one layer. A model's own node adds its parameters.

    A field ending in ``_O`` has one value per output channel.
    """

    @property
    def kind(self) -> str:
        """The model's name in metadata and reports (``IF``, ``LIF``, ``relu``, ...)."""
        raise NotImplementedError(f"{type(self).__name__} defines no kind, expected a property with a name")

    @property
    def states(self) -> tuple[str, ...]:
        """Names of a neuron's state variables: its membrane, and what else it keeps from step to step."""
        raise ExportError(f"{type(self).__name__} does not name its states, expected a property 'states'")

    def facts(self) -> dict[str, Any]:
        """Plain values of all parameters; one number where all channels share it."""
        facts: dict[str, Any] = {"neuron": self.kind}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value = float(value[0]) if (value == value[0]).all() else value.tolist()
            facts[field.name.removesuffix("_O")] = value
        return facts


@dataclass(frozen=True)
class Layer:
    """Synapses and the neurons that they feed."""

    synapses: SynapseNode
    neurons: NeuronNode

    @property
    def name(self) -> str:
        """The layer's name, which is that of its synapses."""
        return self.synapses.name

    @property
    def output_shape(self) -> tuple[int, ...]:
        """Shape of its spikes at a simulation step."""
        return self.synapses.output_shape


def no_rule(reader: str, node: SynapseNode | NeuronNode, rules: Mapping[Any, object], remedy: str) -> ExportError:
    """The error of a reader that meets a node without a rule.

    Args:
        reader: who reads (``ONNX``, ``NIR``, ...).
        node: what it met.
        rules: the reader's rules by node type: the ``registry`` of its ``functools.singledispatch`` function.
        remedy: what a user can do.
    """
    known = " or ".join(kind.__name__ for kind in rules if kind is not object)
    return ExportError(f"{reader} cannot express {node.kind} ({type(node).__name__}), expected {known}; {remedy}")


def side_by_side(nodes: Sequence[NeuronNode]) -> NeuronNode:
    """Neurons of several layers as those of one layer, channel after channel (the streams of a dueling network).

    Raises:
        ExportError: the layers differ in more than per-channel parameters.
    """
    first = nodes[0]
    if any(type(node) is not type(first) for node in nodes):
        kinds = ", ".join(type(node).__name__ for node in nodes)
        raise ExportError(f"layers side by side have neurons {kinds}, expected one kind; use the same neuron in each")
    merged: dict[str, Any] = {}
    for field in dataclasses.fields(first):
        values = [getattr(node, field.name) for node in nodes]
        if field.name.endswith("_O"):
            merged[field.name] = np.concatenate(values)
        elif all(value == values[0] for value in values):
            merged[field.name] = values[0]
        else:
            raise ExportError(f"layers side by side have {field.name} {values}, expected the same value in each")
    return dataclasses.replace(first, **merged)
