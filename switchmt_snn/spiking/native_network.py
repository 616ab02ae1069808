"""A network's decision through the native neuron layers: the same function as :meth:`QNetwork.decide`.

Synaptic products are :mod:`switchmt_snn.spiking.native_products`', neurons :mod:`switchmt_snn.spiking.native`'s, and
channels lie innermost.

Shapes: S steps of an input (T, or 1 that all steps share), T simulation steps, B batch, R rows, C channels, N neurons.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from switchmt_snn.spiking.native import Form, Neurons, Spikes, batch_moments, scaled_images
from switchmt_snn.spiking.native_products import Synapses, connected, convolved, spikes_as_bits
from switchmt_snn.spiking.network import Context, QNetwork, Stream, TrunkLayer

_STREAMS = "streams"
"""All streams have the same inputs, so their synapses are one layer."""


class Weights(NamedTuple):
    """A network as one task sees it, until its parameters change: the copies of weights are then written anew."""

    synapses: dict[str, Synapses]
    """By layer name."""
    gain_N: Tensor
    """Of the dendrites of all streams, one after the other."""
    context: Context


class NativeNetwork:
    """Q-values of a network that is read at every call.

    With ``torch.bfloat16``, weights, synaptic products and the gradients of products and inputs are rounded to it, as
    under autocast; biases and the gradients of weights are not, except in PyTorch's products. All else is float32.
    Everything is on the CPU. A change of parameters through ``.data`` is not seen.
    """

    def __init__(self, network: QNetwork, precision: torch.dtype | None) -> None:
        """Raises ValueError for a network that the native engine has no code for."""
        self._network = network
        self._parameters = list(network.parameters())
        self._dtype = torch.float32 if precision is None else precision
        self._form: Form = "bits" if spikes_as_bits(self._dtype) else "numbers"
        self._neurons = Neurons(network.config)
        layers = {name: [layer] for name, layer in network.trunk.items()} | {_STREAMS: [*network.streams.values()]}
        self._layers = {name: _modules(owners) for name, owners in layers.items()}
        self._matrices: dict[str, Tensor] = {}
        self._copies: dict[Tensor, Tensor] = {}
        for name, modules in self._layers.items():
            if all(isinstance(module, nn.Linear) for module in modules):
                weights = [module.weight for module in modules]
                sizes = [len(weight) for weight in weights]
                self._matrices[name] = torch.empty(sum(sizes), weights[0].shape[1], dtype=self._dtype)
                self._copies |= dict(zip(weights, self._matrices[name].split(sizes), strict=True))
        self._copied_version = self._version = -1
        self._synapses: dict[str, Synapses] = {}
        self._by_task: dict[int, Weights] = {}

    def inputs(self, observation: Tensor, generator: torch.Generator) -> Tensor:
        """Encoded inputs ``[S, B, H, W, C]`` or ``[S, B, C]`` in the products' dtype for raw observations."""
        network = self._network
        if network.config.encoding == "direct" and observation.dtype == torch.uint8 and observation.dim() == 4:
            images = scaled_images(observation, network.observation.scale, self._dtype)
            return images.permute(0, 2, 3, 1).unsqueeze(0)
        x = network.encode(observation, generator).to(self._dtype)
        return x.movedim(2, -1).contiguous()

    def copies(self) -> dict[Tensor, Tensor]:
        """The copies of weights that products read, by parameter; none if they are not those of the parameters as they
        are now. Who changes parameters may change all their copies as well, and say so (:meth:`copies_are_true`); else
        :meth:`weights` makes them anew."""
        return self._copies if self._version_now() == self._copied_version else {}

    def copies_are_true(self) -> None:
        """All copies are those of the parameters as they are now."""
        self._copied_version = self._version_now()

    def _version_now(self) -> int:
        return sum(parameter._version for parameter in self._parameters)

    def weights(self, task: int) -> Weights:
        """For a task, as they are now; those of a network without gradients are kept until they change."""
        version = self._version_now()
        if version != self._version or any(parameter.requires_grad for parameter in self._parameters):
            self._synapses = self._read_synapses(version)
            self._version, self._by_task = version, {}
        if task not in self._by_task:
            context = self._network.context(task)
            gains = [_gains(cast(Stream, stream), context[name]) for name, stream in self._network.streams.items()]
            self._by_task[task] = Weights(self._synapses, torch.cat(gains), context)
        return self._by_task[task]

    def _read_synapses(self, version: int) -> dict[str, Synapses]:
        if version != self._copied_version:
            with torch.no_grad():
                for parameter, copy in self._copies.items():
                    copy.copy_(parameter)
            self._copied_version = version
        synapses = {}
        for name, modules in self._layers.items():
            if name in self._matrices:
                synapses[name] = Synapses.of_linear(cast(list[nn.Linear], modules), self._matrices[name])
            else:
                synapses[name] = Synapses.of_convolution(cast(nn.Conv2d, modules[0]), self._dtype)
        return synapses

    def decide(self, x: Tensor, weights: Weights, training: bool, beside: Sequence[Tensor] = ()) -> list[Tensor]:
        """Q-values ``[B, A]`` of :meth:`inputs`, normalised as ``training`` says; and after them those of other inputs,
        normalised by the running statistics and without gradient."""
        with torch.no_grad():  # first: training moves the running statistics
            others = [self._features(other, weights, training=False) for other in beside]
        y_TBN, *others_TBN = connected(self._features(x, weights, training), weights.synapses[_STREAMS], others)
        q_BA = self._read_out(y_TBN, weights)
        with torch.no_grad():
            return [q_BA, *(self._read_out(other_TBN, weights) for other_TBN in others_TBN)]

    def _features(self, x: Tensor, weights: Weights, training: bool) -> Spikes:
        """What the trunk sends to the streams."""
        spikes, (synapses, _, context) = Spikes(x), weights
        for name, layer in self._network.trunk.items():
            spikes = self._trunk_layer(cast(TrunkLayer, layer), spikes, context[name], synapses[name], training)
        return spikes

    def _read_out(self, y_TBN: Tensor, weights: Weights) -> Tensor:
        """Q-values of the streams' synaptic products, which lie one after the other."""
        network, over_time = self._network, self._network.config.readout == "mean"
        spikes_TBN = self._neurons.gated(y_TBN, weights.gain_N, "mean" if over_time else "floats").numbers
        sizes, outputs = [bias.shape[0] for bias in weights.synapses[_STREAMS].parameters[1::2]], {}
        for (name, layer), part_TBN in zip(network.streams.items(), spikes_TBN.split(sizes, dim=-1), strict=True):
            stream = cast(Stream, layer)
            outputs[name] = stream.head(part_TBN[0]) if over_time else network.read_out(stream, part_TBN)
        return network.combine(outputs)

    def _trunk_layer(
        self, layer: TrunkLayer, x: Spikes, context: tuple[Tensor, ...], synapses: Synapses, training: bool
    ) -> Spikes:
        """Spikes ``[T, B, h, w, C]`` or ``[T, B, C]``, as the next layer reads them."""
        if layer.normalization is None:
            (y_SBN,) = connected(x, synapses)
            return self._neurons.gated(y_SBN, None, self._form)
        y = convolved(x, synapses)
        y_SRC = y.flatten(1, -2)
        normalization, (mean_C, var_C) = layer.normalization, context
        if training:
            mean_C, var_C = batch_moments(y_SRC.detach())
            normalization.move(context, mean_C, var_C, y_SRC.shape[0] * y_SRC.shape[1])
        spikes = self._neurons.normalized(
            y_SRC,
            normalization.weight,
            normalization.bias,
            (mean_C, var_C),
            normalization.epsilon,
            of_batch=training,
            form=self._form,
        )
        return spikes.with_rows(y.shape[1:-1])


def _gains(stream: Stream, context: tuple[Tensor, ...]) -> Tensor:
    size = stream.synapses.out_features
    return torch.ones(size) if stream.dendrites is None else stream.dendrites.gains(*context).expand(size)


def _modules(owners: list[nn.Module]) -> list[nn.Linear | nn.Conv2d]:
    """The modules that have the synapses."""
    synapses = (cast(TrunkLayer | Stream, owner).synapses for owner in owners)
    return [cast(nn.Linear | nn.Conv2d, part[-1] if isinstance(part, nn.Sequential) else part) for part in synapses]
