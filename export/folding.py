"""Folding: a trained Q-network as one chain of synaptic layers and neuron layers, the single source of every export.

BatchNorm (with a task's running statistics) and the dendritic gain of a task are affine maps of a layer's output
channels, so a layer of task k is ``current = scale[k] * (W x) + shift[k]``, computed in float64. The two streams of
a dueling network are laid side by side as one linear layer, and its head becomes ``[value | advantage minus its mean
over actions]``: one plain chain, with the same values.

Shapes: O output channels or features, I input channels or features, K tasks, A actions, N neurons of a layer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from switchmt_snn.acting.agent import Agent
from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import ExportError
from switchmt_snn.spiking.layers import side_by_side
from switchmt_snn.spiking.network import QNetwork, Stream, TrunkLayer
from switchmt_snn.spiking.neurons import LeakyNode, NeuronLayer, ReLUNode
from switchmt_snn.tasks.suite import TaskSuite

Array = npt.NDArray[np.float64]

SPIKE_ENCODINGS = ("rate", "latency", "events")
"""Encodings whose values are spikes."""


@dataclass(frozen=True)
class Neurons:
    """Neurons of one layer. Beta and threshold may differ by output channel: two streams may have learned their own.

    Attributes:
        kind: ``IF`` (beta 1), ``LIF``, or ``relu`` for the ANN methods.
        beta_O: membrane decay per simulation step.
        threshold_O: a neuron fires when its membrane is strictly above it.
        reset: ``zero`` or ``subtract``.
    """

    kind: str
    beta_O: Array
    threshold_O: Array
    reset: str

    def facts(self) -> dict[str, Any]:
        """Plain values; one number where all neurons share it."""
        beta, threshold = (
            float(values[0]) if (values == values[0]).all() else values.tolist()
            for values in (self.beta_O, self.threshold_O)
        )
        return {"neuron": self.kind, "beta": beta, "threshold": threshold}


@dataclass(frozen=True)
class Layer:
    """Synapses and the neurons they feed: ``current = scale_KO[k] * (W x) + shift_KO[k]`` for task k.

    Attributes:
        name: ``conv1`` ..., ``linear1``, ``hidden`` (the streams' hidden layer) or ``head``.
        weight: ``[O, I, kh, kw]`` of a convolution, ``[O, I]`` of a linear layer.
        scale_KO: what BatchNorm and dendrites multiply.
        shift_KO: the bias after them.
        stride: of a convolution (no padding, no groups); None for a linear layer.
        input_shape: ``(C, H, W)`` or ``(features,)``.
        output_shape: ``(O, H, W)`` or ``(O,)``.
        neurons: None for the head.
        groups: equal parts of the output that :attr:`k_winners` compares within (a dueling network has two).
        k_winners: currents kept per group and step, or None.
        weight_steps_O: of a quantised layer: weight = integer times this step, per output channel.
    """

    name: str
    weight: Array
    scale_KO: Array
    shift_KO: Array
    stride: int | None
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    neurons: Neurons | None
    groups: int = 1
    k_winners: int | None = None
    weight_steps_O: Array | None = None

    @property
    def is_convolution(self) -> bool:
        """Whether the synapses are a convolution."""
        return self.stride is not None

    @property
    def depends_on_task(self) -> bool:
        """Whether tasks differ in scale or shift."""
        return bool((self.scale_KO != self.scale_KO[:1]).any() or (self.shift_KO != self.shift_KO[:1]).any())

    def folded(self, task: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Weight and bias of one task, scale and shift multiplied in, as float32."""
        scale = self.scale_KO[task].reshape(-1, *(1,) * (self.weight.ndim - 1))
        return (self.weight * scale).astype(np.float32), self.shift_KO[task].astype(np.float32)


@dataclass(frozen=True)
class FoldedNetwork:
    """A Q-network for all its tasks, ready to export.

    Attributes:
        layers: in forward order; the last one is the head, which sees the mean over T of the spikes before it
            (readout ``mean``) or every step's spikes.
        config: the run's resolved config.
        suite: the tasks.
        step: training step of the weights.
    """

    layers: tuple[Layer, ...]
    config: ExperimentConfig
    suite: TaskSuite
    step: int

    @property
    def hidden_layers(self) -> tuple[Layer, ...]:
        """All layers with neurons."""
        return self.layers[:-1]

    @property
    def head(self) -> Layer:
        """The last layer, without neurons."""
        return self.layers[-1]

    @property
    def spiking(self) -> bool:
        """Whether the neurons spike."""
        return any(layer.neurons is not None and layer.neurons.kind != "relu" for layer in self.layers)

    @property
    def sees_spikes(self) -> bool:
        """Whether the first layer's inputs are spikes."""
        return self.config.network.encoding in SPIKE_ENCODINGS

    @property
    def encoded_shape(self) -> tuple[int, ...]:
        """Shape of the input at one simulation step, after encoding."""
        return self.layers[0].input_shape


def fold(agent: Agent) -> FoldedNetwork:
    """Fold an agent's network for all its tasks.

    Raises:
        ExportError: a weight is not finite.
    """
    network = agent.network
    for name, tensor in network.state_dict().items():
        if not torch.isfinite(tensor).all():
            raise ExportError(f"{name} holds values that are not finite, expected numbers; export another checkpoint")
    tasks = range(len(agent.suite.names))
    layers = [_trunk_layer(name, cast(TrunkLayer, layer), tasks) for name, layer in network.trunk.items()]
    layers = _with_shapes(layers, network)
    features = int(np.prod(layers[-1].output_shape))
    layers += _streams(network, features, tasks)
    return FoldedNetwork(tuple(layers), agent.config, agent.suite, agent.step)


def _float64(tensor: Tensor) -> Array:
    return cast(Array, tensor.detach().cpu().to(torch.float64).numpy())


def _neurons(layers: list[tuple[nn.Module, int]]) -> Neurons:
    """Neuron layers side by side, each with its number of channels."""
    node = side_by_side([cast(NeuronLayer, layer).node(channels) for layer, channels in layers])
    if isinstance(node, ReLUNode):
        return Neurons("relu", np.zeros(1), np.zeros(1), "none")
    if isinstance(node, LeakyNode):
        return Neurons(node.kind, node.beta_O, node.threshold_O, node.reset)
    raise ExportError(f"network.neuron is {node.kind}, expected IF or LIF; exports do not have it")


def _trunk_layer(name: str, layer: TrunkLayer, tasks: range) -> Layer:
    """Fold BatchNorm: ``(y - mean) * weight / sqrt(var + eps) + bias`` for ``y = W x + b``; shapes come later."""
    synapses = layer.synapses[-1] if isinstance(layer.synapses, nn.Sequential) else layer.synapses
    weight, bias_O = _float64(cast(Tensor, synapses.weight)), _float64(cast(Tensor, synapses.bias))
    scale_KO, shift_KO = np.ones((len(tasks), len(bias_O))), np.tile(bias_O, (len(tasks), 1))
    if layer.normalization is not None:
        norm = layer.normalization
        for task in tasks:
            mean_O, var_O = (_float64(value) for value in norm.statistics(task))
            scale_KO[task] = _float64(norm.weight) / np.sqrt(var_O + norm.epsilon)
            shift_KO[task] = (bias_O - mean_O) * scale_KO[task] + _float64(norm.bias)
    stride = synapses.stride[0] if isinstance(synapses, nn.Conv2d) else None
    neurons = _neurons([(layer.neurons, len(bias_O))])
    return Layer(name, weight, scale_KO, shift_KO, stride, (), (), neurons)


def _with_shapes(layers: list[Layer], network: QNetwork) -> list[Layer]:
    """Fill in input and output shapes from the observation on."""
    observation = network.observation
    shape = (network.encoder.input_channels(observation.shape[0]), *observation.shape[1:])
    shaped = []
    for layer in layers:
        if layer.stride is None:
            out: tuple[int, ...] = (len(layer.weight),)
        else:
            kernel = layer.weight.shape[2]
            out = (len(layer.weight), *((side - kernel) // layer.stride + 1 for side in shape[1:]))
        shaped.append(replace(layer, input_shape=tuple(shape), output_shape=out))
        shape = out
    return shaped


def _streams(network: QNetwork, features: int, tasks: range) -> list[Layer]:
    """The hidden layer of all streams side by side, and their heads as one."""
    streams = {name: cast(Stream, stream) for name, stream in network.streams.items()}
    parts: list[tuple[Array, Array, Array]] = []
    for stream in streams.values():
        weight_OI, bias_O = _float64(stream.synapses.weight), _float64(stream.synapses.bias)
        gain_KO = np.ones((len(tasks), len(bias_O)))
        if stream.dendrites is not None:
            with torch.no_grad():
                gain_KO = np.stack([np.broadcast_to(_float64(stream.dendrites(k)), bias_O.shape) for k in tasks])
        parts.append((weight_OI, gain_KO, gain_KO * bias_O))
    first = next(iter(streams.values()))
    hidden = Layer(
        name="hidden",
        weight=np.concatenate([weight for weight, _, _ in parts]),
        scale_KO=np.concatenate([gain for _, gain, _ in parts], axis=1),
        shift_KO=np.concatenate([shift for _, _, shift in parts], axis=1),
        stride=None,
        input_shape=(features,),
        output_shape=(sum(len(weight) for weight, _, _ in parts),),
        neurons=_neurons([(stream.neurons, stream.synapses.out_features) for stream in streams.values()]),
        groups=len(streams),
        k_winners=first.k_winners if first.k_winners and first.k_winners < first.synapses.out_features else None,
    )
    weight_AN, bias_A = _head({name: stream.head for name, stream in streams.items()})
    ones_KA = np.ones((len(tasks), len(bias_A)))
    head = Layer("head", weight_AN, ones_KA, ones_KA * bias_A, None, hidden.output_shape, bias_A.shape, None)
    return [hidden, head]


def _head(heads: dict[str, nn.Linear]) -> tuple[Array, Array]:
    """Q = q(h), or V(h) + A(h) - mean over actions of A(h) as one linear map of ``[h_value, h_advantage]``."""
    weights = {name: (_float64(head.weight), _float64(head.bias)) for name, head in heads.items()}
    if "q" in weights:
        return weights["q"]
    (value_1N, value_1), (advantage_AN, advantage_A) = weights["value"], weights["advantage"]
    actions = len(advantage_A)
    weight = np.concatenate([np.repeat(value_1N, actions, axis=0), advantage_AN - advantage_AN.mean(axis=0)], axis=1)
    return weight, value_1 + advantage_A - advantage_A.mean()


def quantized(network: FoldedNetwork, bits: int = 8) -> FoldedNetwork:
    """Weights as integers of ``bits`` bits times one step per output channel (symmetric, no zero point).

    BatchNorm and gains scale whole output channels, so every task shares the integers. Shifts stay float32.
    """
    largest = 2 ** (bits - 1) - 1
    layers = []
    for layer in network.layers:
        peak_O = np.abs(layer.weight).reshape(len(layer.weight), -1).max(axis=1)
        steps_O = np.where(peak_O > 0, peak_O / largest, 1.0).astype(np.float32).astype(np.float64)
        per_weight = steps_O.reshape(-1, *(1,) * (layer.weight.ndim - 1))
        integers = np.clip(np.rint(layer.weight / per_weight), -largest, largest)
        layers.append(replace(layer, weight=integers * per_weight, weight_steps_O=steps_O))
    return replace(network, layers=tuple(layers))


def metadata(network: FoldedNetwork) -> dict[str, Any]:
    """What a host must know to use an export, as plain values (strings, numbers, lists, dicts)."""
    config, suite = network.config, network.suite
    settings = config.network
    return {
        "method": settings.method,
        "timesteps": settings.timesteps,
        "encoding": settings.encoding,
        "event_threshold": settings.event_threshold,
        "readout": settings.readout,
        "readout_beta": settings.readout_beta,
        "reset": settings.reset if network.spiking else "none",
        "fires_when": "membrane > threshold" if network.spiking else "never",
        "neurons": {layer.name: layer.neurons.facts() for layer in network.layers if layer.neurons is not None},
        "tasks": list(suite.names),
        "actions": list(suite.action_names),
        "valid_actions": {
            name: np.flatnonzero(suite.valid_actions_KA[k]).tolist() for k, name in enumerate(suite.names)
        },
        "observation_shape": list(suite.observation_shape),
        "frame_stack": suite.frame_stack,
        "scale": suite.scale,
        "layers": [layer.name for layer in network.layers],
        "training_step": network.step,
    }
