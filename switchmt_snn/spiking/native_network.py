"""A network's decision through the native neuron layers: the same function as :meth:`QNetwork.decide`.

Synaptic products are :mod:`switchmt_snn.spiking.native_products`', neurons :mod:`switchmt_snn.spiking.native`'s, and
channels lie innermost.

Shapes: S steps of an input (T, or 1 that all steps share), T simulation steps, B batch, R rows, C channels, N neurons.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from switchmt_snn.spiking.native import Form, Neurons, Spikes, batch_moments, scaled_images
from switchmt_snn.spiking.native_products import Synapses, connected, convolved, spikes_as_bits
from switchmt_snn.spiking.network import Context, QNetwork, Stream, TrunkLayer

_STREAMS = "streams"
"""All streams have the same inputs, so their synapses are one layer."""


class NativeNetwork:
    """Q-values of a network that is read at every call.

    With ``torch.bfloat16``, weights, synaptic products and the gradients of products and inputs are rounded to it, as
    under autocast; where spikes are bits, biases and the gradients of weights are not. All else is float32. Everything
    is on the CPU.
    """

    def __init__(self, network: QNetwork, precision: torch.dtype | None) -> None:
        """Raises ValueError for a network that the native engine has no code for."""
        self._network = network
        self._parameters = list(network.parameters())
        self._dtype = torch.float32 if precision is None else precision
        self._form: Form = "bits" if spikes_as_bits(self._dtype) else "numbers"
        self._neurons = Neurons(network.config)
        self._frozen: tuple[int, dict[str, Synapses]] | None = None

    def inputs(self, observation: Tensor, generator: torch.Generator) -> Tensor:
        """Encoded inputs ``[S, B, H, W, C]`` or ``[S, B, C]`` in the products' dtype for raw observations."""
        network = self._network
        if network.config.encoding == "direct" and observation.dtype == torch.uint8 and observation.dim() == 4:
            images = scaled_images(observation, network.observation.scale, self._dtype)
            return images.permute(0, 2, 3, 1).unsqueeze(0)
        x = network.encode(observation, generator).to(self._dtype)
        return x.movedim(2, -1).contiguous()

    def synapses(self) -> dict[str, Synapses]:
        """All layers' synapses as they are now, by layer name; those of a network without gradients are kept."""
        version = sum(parameter._version for parameter in self._parameters)
        if self._frozen is not None and self._frozen[0] == version:
            return self._frozen[1]
        network = self._network
        owners = {name: [layer] for name, layer in network.trunk.items()} | {_STREAMS: [*network.streams.values()]}
        synapses = {name: Synapses.of(_layers(parts), self._dtype) for name, parts in owners.items()}
        if not any(parameter.requires_grad for parameter in self._parameters):
            self._frozen = version, synapses
        return synapses

    def decide(self, x: Tensor, context: Context, synapses: dict[str, Synapses], training: bool) -> Tensor:
        """Q-values ``[B, A]`` of :meth:`inputs` in a task's context; normalisation as ``training`` says."""
        network, spikes = self._network, Spikes(x)
        for name, layer in network.trunk.items():
            spikes = self._trunk_layer(cast(TrunkLayer, layer), spikes, context[name], synapses[name], training)
        y_TBN = connected(spikes, synapses[_STREAMS])
        sizes = [bias.shape[0] for bias in synapses[_STREAMS].parameters[1::2]]
        gains = []
        for (name, stream), size in zip(network.streams.items(), sizes, strict=True):
            dendrites = cast(Stream, stream).dendrites
            gains.append(torch.ones(size) if dendrites is None else dendrites.gains(*context[name]).expand(size))
        over_time = network.config.readout == "mean"
        spikes_TBN = self._neurons.gated(y_TBN, torch.cat(gains), "mean" if over_time else "floats").numbers
        outputs = {}
        for (name, layer), part_TBN in zip(network.streams.items(), spikes_TBN.split(sizes, dim=-1), strict=True):
            stream = cast(Stream, layer)
            outputs[name] = stream.head(part_TBN[0]) if over_time else network.read_out(stream, part_TBN)
        return network.combine(outputs)

    def _trunk_layer(
        self, layer: TrunkLayer, x: Spikes, context: tuple[Tensor, ...], synapses: Synapses, training: bool
    ) -> Spikes:
        """Spikes ``[T, B, h, w, C]`` or ``[T, B, C]``, as the next layer reads them."""
        if layer.normalization is None:
            y_SBN = connected(x, synapses)
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


def _layers(owners: list[nn.Module]) -> list[nn.Linear | nn.Conv2d]:
    """The modules that have the synapses."""
    synapses = (cast(TrunkLayer | Stream, owner).synapses for owner in owners)
    return [cast(nn.Linear | nn.Conv2d, part[-1] if isinstance(part, nn.Sequential) else part) for part in synapses]
