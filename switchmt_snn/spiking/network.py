"""The Q-network of all seven methods.

Shapes: T simulation steps, B batch, C channels, H W image, K tasks, A actions, M quantiles, N neurons.

    trunk  : nature   Conv 4->32 k8 s4 | Conv 32->64 k4 s2 | Conv 64->64 k3 s1, each with BatchNorm and neurons
             minatar  Conv c->16 k3 s1 with BatchNorm and neurons
             mlp      Linear ->hidden with neurons (and BatchNorm if ``network.mlp_normalization`` says so)
    stream : Linear ->hidden, gain of the active dendrites, neurons, Linear ->outputs
    plain  : one stream with A outputs                       (paper, section 3.1)
    dueling: Q = V + A - mean_a(A), a stream for each

With M quantiles, a head has M sets of its outputs, one set after the other; each set gives one quantile of all actions,
and Q is the mean over the sets. With heads per task, each task has rows of its own in the last linear layer.

Stateless layers see time folded into the batch ``[T*B, ...]``; only neurons walk over T. Under direct encoding the
first layer and its BatchNorm are computed once, since every step has the same input. The head is linear, so for the
``mean`` readout it is applied once, to the mean spikes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from switchmt_snn.config import METHOD_TRAITS, NetworkConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.dendrites import ActiveDendrites, keep_k_winners, make_dendrites
from switchmt_snn.spiking.encodings import make_encoding
from switchmt_snn.spiking.heads import TaskHeads, make_head
from switchmt_snn.spiking.neurons import NeuronLayer, NeuronState, make_neuron_layer
from switchmt_snn.spiking.normalization import TaskBatchNorm, make_mlp_normalization, make_stream_normalization
from switchmt_snn.spiking.readout import make_readout
from switchmt_snn.spiking.settings import require_known

CONVOLUTIONS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "nature": ((32, 8, 4), (64, 4, 2), (64, 3, 1)),
    "nature_half": ((16, 8, 4), (32, 4, 2), (32, 3, 1)),
    "minatar": ((16, 3, 1),),
    "mlp": (),
}
"""(output channels, kernel, stride) of each trunk's convolutions."""

MOST_WEIGHTS = 2**25
"""Most weights of a layer (128 MiB): a size that is meant is far below (the paper's largest layer has 1.6 million)."""

State = dict[str, NeuronState]
"""State variables of each layer's neurons (``NeuronLayer.STATE``) by layer name; an empty dict is the resting state."""

Context = dict[str, tuple[Tensor, ...]]
"""All that tells a network its task, by layer name: BatchNorm's running mean and variance ``[C]``, and the task's index
``[1]``."""


@dataclass(frozen=True)
class ObservationSpec:
    """What the network is told about the tasks it serves.

    Attributes:
        shape: stacked observation, channels first: ``(k*c, H, W)`` or ``(k*features,)``.
        frame_stack: frames k in it.
        scale: factor that brings raw values to the network's range (1/255 for 8-bit images).
        in_unit_range: whether scaled values lie in [0, 1].
        num_actions: A, the same for every task.
        num_tasks: K.
    """

    shape: tuple[int, ...]
    frame_stack: int
    scale: float
    in_unit_range: bool
    num_actions: int
    num_tasks: int


def synaptic_products(synapses: nn.Module, x: Tensor, precision: torch.dtype | None) -> Tensor:
    """``W x + b`` with weights and inputs rounded to a dtype (spikes stay exact); None rounds nothing.

    What comes after (normalisation, gain, membranes, head) is in the dtype of ``x``.
    """
    if precision is None:
        return cast(Tensor, synapses(x))
    with torch.autocast(x.device.type, precision):
        return cast(Tensor, synapses(x)).to(x.dtype)


class Convolution(nn.Conv2d):
    """``nn.Conv2d`` without padding; compiled code computes it with channels innermost."""

    def forward(self, x: Tensor) -> Tensor:
        """``[B, C, H, W]`` to ``[B, O, H', W']``."""
        if not torch.compiler.is_compiling():
            return super().forward(x)
        weight = self.weight.contiguous(memory_format=torch.channels_last)
        return F.conv2d(x, weight, self.bias, self.stride)


class TrunkLayer(nn.Module):
    """Convolution (or linear map), BatchNorm, neurons."""

    def __init__(self, synapses: nn.Module, normalization: TaskBatchNorm | None, neurons: NeuronLayer):
        super().__init__()
        self.synapses = synapses
        self.normalization = normalization
        self.neurons = neurons

    def context(self, task: int) -> tuple[Tensor, ...]:
        """The running mean and variance ``[C]`` of a task, as views; nothing without normalisation."""
        return () if self.normalization is None else self.normalization.statistics(task)

    def current(self, x: Tensor, context: tuple[Tensor, ...], precision: torch.dtype | None, training: bool) -> Tensor:
        """Input currents ``[T, B, ...]`` of the neurons for inputs ``[T, B, ...]``, time folded into the batch."""
        y = synaptic_products(self.synapses, x.flatten(0, 1), precision)
        if self.normalization is not None:
            y = self.normalization.normalize(y, context, training)
        return cast(Tensor, y.unflatten(0, x.shape[:2]))


class Stream(nn.Module):
    """Linear, normalization (if set), dendritic gain, neurons, linear head: one Q, value or advantage stream."""

    def __init__(self, config: NetworkConfig, num_features: int, num_outputs: int, num_tasks: int, spiking: bool):
        """``num_outputs`` are those of one quantile."""
        super().__init__()
        hidden = cast(int, config.hidden_units)
        self.synapses = nn.Linear(num_features, hidden)
        self.normalization = make_stream_normalization(config, hidden, num_tasks)
        self.dendrites = make_dendrites(config, hidden, num_tasks)
        self.k_winners = config.k_winners
        self.neurons = make_neuron_layer(config, spiking)
        self.head = make_head(config, hidden, config.quantiles * num_outputs, num_tasks)

    def context(self, task: int) -> tuple[Tensor, ...]:
        """The running mean and variance ``[N]`` with normalization, then a task's index ``[1]`` with dendrites or heads
        per task."""
        statistics = () if self.normalization is None else self.normalization.statistics(task)
        for part in (self.dendrites, self.head):
            if isinstance(part, (ActiveDendrites, TaskHeads)):
                return (*statistics, part.index(task))
        return statistics

    def current(
        self, x_TBN: Tensor, context: tuple[Tensor, ...], precision: torch.dtype | None, training: bool
    ) -> Tensor:
        """Gated input currents ``[T, B, N]`` of the hidden neurons: Eq. 1's ``f(sum_i s_i, max_j d_j^T c)``."""
        current_TBN = synaptic_products(self.synapses, x_TBN, precision)
        if self.normalization is not None:
            folded = self.normalization.normalize(current_TBN.flatten(0, 1), context[:2], training)
            current_TBN = folded.unflatten(0, x_TBN.shape[:2])
        if self.dendrites is not None:
            current_TBN = current_TBN * self.dendrites.gains(context[-1])
        if self.k_winners is not None:
            current_TBN = keep_k_winners(current_TBN, self.k_winners)
        return current_TBN

    def outputs(self, spikes: Tensor, context: tuple[Tensor, ...]) -> Tensor:
        """The head's outputs ``[..., O]`` for hidden spikes ``[..., N]``."""
        if isinstance(self.head, TaskHeads):
            return self.head.of_task(spikes, context[-1])
        return cast(Tensor, self.head(spikes))


class QNetwork(nn.Module):
    """Observations of one task -> Q-values. Build it with ``build_network``.

    Attributes:
        config: the resolved network settings.
        observation: what the input looks like.
        trunk: layers that all streams share.
        streams: ``{"q": ...}`` or ``{"value": ..., "advantage": ...}``.
    """

    def __init__(self, config: NetworkConfig, observation: ObservationSpec) -> None:
        super().__init__()
        traits = METHOD_TRAITS[config.method]
        self.config = config
        self.observation = observation
        self.spiking = traits.spiking
        self.readout = make_readout(config)
        self.encoder = make_encoding(config, observation.frame_stack, observation.in_unit_range)
        self.trunk = nn.ModuleDict()
        shape = self._build_trunk()
        features = math.prod(shape)
        outputs = (
            {"value": 1, "advantage": observation.num_actions} if traits.dueling else {"q": observation.num_actions}
        )
        self._require_size(features, config.quantiles * observation.num_actions)
        self.streams = nn.ModuleDict(
            {name: Stream(config, features, n, observation.num_tasks, self.spiking) for name, n in outputs.items()}
        )

    def _require_size(self, inputs: int, outputs: int) -> None:
        """Refuse layers that would fill the memory before anything can say so.

        Args:
            inputs: of a stream, or of the mlp trunk.
            outputs: of a stream's head for one task.
        """
        config, tasks = self.config, self.observation.num_tasks
        hidden = cast(int, config.hidden_units)
        per_neuron = hidden if config.dendrites == "per_neuron" else 1
        heads = tasks if config.heads == "per_task" else 1
        sizes = {
            "hidden_units": (hidden * inputs, f"for {inputs:,} inputs", ", or make the observations smaller"),
            "quantiles": (hidden * outputs * heads, f"for {outputs * heads:,} outputs", ", or take fewer actions"),
            "dendritic_segments": (config.dendritic_segments * tasks * per_neuron, f"for {tasks} tasks", ""),
        }
        for name, (weights, where, other) in sizes.items():
            if weights > MOST_WEIGHTS:
                raise ConfigError(
                    f"network.{name} is {getattr(config, name)}, which makes a layer of {weights:,} weights {where}, "
                    f"expected at most {MOST_WEIGHTS:,}; lower it{other}"
                )

    def _build_trunk(self) -> tuple[int, ...]:
        """Append the trunk's layers and return the shape of the last one's output."""
        config, observation = self.config, self.observation
        require_known("trunk", config.trunk, CONVOLUTIONS, "switchmt_snn.config.resolve replaces auto")
        require_known("normalization", config.normalization, ("per_task", "shared"))
        channels = self.encoder.channels(observation.shape[0], observation.frame_stack)
        shape: tuple[int, ...] = (channels, *observation.shape[1:])
        if config.trunk == "mlp":
            hidden = cast(int, config.hidden_units)
            self._require_size(math.prod(shape), 1)
            # An image is flattened, so that the trunk takes any observation.
            synapses = nn.Sequential(nn.Flatten(1), nn.Linear(math.prod(shape), hidden))
            normalization = make_mlp_normalization(config, hidden, observation.num_tasks)
            self.trunk["linear1"] = TrunkLayer(synapses, normalization, make_neuron_layer(config, self.spiking))
            return (hidden,)
        if len(shape) != 3:
            raise ConfigError(
                f"network.trunk is {config.trunk!r}, expected mlp for observations of shape {observation.shape}; "
                "convolutions need images"
            )
        for index, (out_channels, kernel, stride) in enumerate(CONVOLUTIONS[config.trunk], start=1):
            convolution = Convolution(shape[0], out_channels, kernel, stride)
            height, width = ((side - kernel) // stride + 1 for side in shape[1:])
            if height < 1 or width < 1:
                raise ConfigError(
                    f"network.trunk is {config.trunk!r}, expected another trunk for {observation.shape[1]}x"
                    f"{observation.shape[2]} images; convolution {index} has no output left"
                )
            shape = (out_channels, height, width)
            normalization = TaskBatchNorm(
                out_channels, observation.num_tasks, config.normalization == "per_task", config.normalization_momentum
            )
            self.trunk[f"conv{index}"] = TrunkLayer(convolution, normalization, make_neuron_layer(config, self.spiking))
        return shape

    def forward(
        self,
        observation: Tensor,
        task: int,
        *,
        state: State | None = None,
        activity: dict[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
        precision: torch.dtype | None = None,
    ) -> Tensor:
        """Q-values of a batch of observations of one task.

        Args:
            observation: ``[B, *shape]``, raw (uint8 or float).
            task: task index k.
            state: neuron states to start from; changed in place to those after the decision. None or an empty dict
                starts from rest and, if None, keeps nothing.
            activity: if given, filled with each neuron layer's spikes (or activations) ``[T, B, ...]`` by name.
            generator: source of random numbers of the ``rate`` encoding.
            precision: dtype of all synaptic products but the head's (``synaptic_products``).

        Returns:
            ``[B, A]`` float Q-values.
        """
        inputs = self.encode(observation, generator)
        return self.decide(inputs, self.context(task), state=state, activity=activity, precision=precision)

    def encode(self, observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The network's inputs ``[T, B, ...]`` (direct: ``[1, B, ...]``) for raw observations ``[B, *shape]``."""
        # Bytes become floats and are scaled in one pass.
        numbers = observation if observation.dtype == torch.uint8 else observation.to(torch.float32)
        return self.encoder(numbers * self.observation.scale, generator)

    def context(self, task: int) -> Context:
        """What a task changes in the network; the only thing that ``decide`` is told of it."""
        layers = {**self.trunk, **self.streams}
        return {name: cast(TrunkLayer | Stream, layer).context(task) for name, layer in layers.items()}

    def decide(
        self,
        x: Tensor,
        context: Context,
        *,
        state: State | None = None,
        activity: dict[str, Tensor] | None = None,
        precision: torch.dtype | None = None,
        training: bool | None = None,
    ) -> Tensor:
        """Q-values ``[B, A]`` of encoded inputs ``[T, B, ...]`` in a task's context; the rest as in ``forward``.

        ``training`` normalises by the batch or by the running statistics; None does as the module's mode says.
        """
        return self.expected(
            self.values(x, context, state=state, activity=activity, precision=precision, training=training)
        )

    def values(
        self,
        x: Tensor,
        context: Context,
        *,
        state: State | None = None,
        activity: dict[str, Tensor] | None = None,
        precision: torch.dtype | None = None,
        training: bool | None = None,
    ) -> Tensor:
        """As ``decide``, but with several quantiles their values ``[B, M, A]``, which training learns."""
        training = self.training if training is None else training
        state = {} if state is None else state
        for name, layer in self.trunk.items():
            current = self._over_time(cast(TrunkLayer, layer).current(x, context[name], precision, training))
            x = self._fire(name, cast(TrunkLayer, layer), current, state, activity)
        features_TBN = x.flatten(2)
        outputs = {
            name: self._read_out(
                name, cast(Stream, stream), features_TBN, context[name], state, activity, precision, training
            )
            for name, stream in self.streams.items()
        }
        return self.readout.q_values(self.combine(outputs))

    def expected(self, values: Tensor) -> Tensor:
        """Q-values ``[B, A]`` of what ``values`` returned: the mean over quantiles."""
        return values if self.config.quantiles == 1 else values.mean(-2)

    def _over_time(self, current: Tensor) -> Tensor:
        """Repeat ``[1, B, ...]`` over T: direct encoding's first layer has the same current at every step."""
        return current.expand(self.config.timesteps, *current.shape[1:]) if current.shape[0] == 1 else current

    def _fire(
        self,
        name: str,
        layer: TrunkLayer | Stream,
        current: Tensor,
        state: State,
        activity: dict[str, Tensor] | None,
    ) -> Tensor:
        spikes, state[name] = layer.neurons(current, state.get(name))
        if activity is not None:
            activity[name] = spikes
        return cast(Tensor, spikes)

    def _read_out(
        self,
        name: str,
        stream: Stream,
        features_TBN: Tensor,
        context: tuple[Tensor, ...],
        state: State,
        activity: dict[str, Tensor] | None,
        precision: torch.dtype | None,
        training: bool,
    ) -> Tensor:
        current_TBN = stream.current(features_TBN, context, precision, training)
        spikes_TBN = self._fire(name, stream, current_TBN, state, activity)
        outputs = self.readout.stream(lambda spikes: stream.outputs(spikes, context), spikes_TBN)
        return outputs if self.config.quantiles == 1 else outputs.unflatten(-1, (self.config.quantiles, -1))

    def value(self, spikes_TBN: Tensor, task: int) -> Tensor | None:
        """The value stream's value ``[B]`` for its hidden spikes; with quantiles their mean.

        None if there is no value stream, or if the readout leaves no single value (``Readout.keeps_streams``).
        """
        if "value" not in self.streams or not self.readout.keeps_streams:
            return None
        stream = cast(Stream, self.streams["value"])
        context = stream.context(task)
        return self.readout.stream(lambda spikes: stream.outputs(spikes, context), spikes_TBN).mean(-1)

    def combine(self, outputs: dict[str, Tensor]) -> Tensor:
        """Q-values ``[..., A]`` from the streams' outputs ``[..., n]``."""
        if "q" in outputs:
            return outputs["q"]
        advantage = outputs["advantage"]
        return outputs["value"] + advantage - advantage.mean(-1, keepdim=True)


def build_network(config: NetworkConfig, observation: ObservationSpec, seed: int) -> QNetwork:
    """A freshly initialised network (PyTorch's default initialisation), the same for the same seed.

    The global torch generator is left as it was.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return QNetwork(config, observation)


def trainable_parameters(network: nn.Module) -> int:
    """Number of trainable parameters (paper, Table 3)."""
    return sum(parameter.numel() for parameter in network.parameters() if parameter.requires_grad)


def deployed_parameters(network: QNetwork) -> int:
    """Parameters of the network that decides for a task: of the heads, the task's own, and only the quantiles' mean."""
    heads = sum(trainable_parameters(cast(Stream, stream).head) for stream in network.streams.values())
    sets = network.observation.num_tasks if network.config.heads == "per_task" else 1
    return trainable_parameters(network) - heads + heads // (sets * network.config.quantiles)
