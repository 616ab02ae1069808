"""A network's decision through the native neuron layers: the same function as :meth:`QNetwork.decide`.

Products are PyTorch's (oneDNN), with channels innermost; what lies between them is :mod:`switchmt_snn.spiking.native`.

Shapes: S steps of an input (T, or 1 that all steps share), T simulation steps, B batch, R rows, C channels, N neurons.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from switchmt_snn.spiking.native import Neurons, batch_moments, scaled_images
from switchmt_snn.spiking.network import Context, QNetwork, Stream, TrunkLayer


class Synapses(NamedTuple):
    """Weights and bias of a layer in the products' dtype; of a convolution, with channels innermost."""

    weight: Tensor
    bias: Tensor
    stride: int


class NativeNetwork:
    """Q-values of a network that is read at every call.

    With ``torch.bfloat16``, synaptic products and their gradients are rounded as under autocast; all else is float32.
    Everything is on the CPU.
    """

    def __init__(self, network: QNetwork, precision: torch.dtype | None) -> None:
        """Raises ValueError for a network that the native engine has no code for."""
        self._network = network
        self._dtype = torch.float32 if precision is None else precision
        self._neurons = Neurons(network.config)
        self._frozen: tuple[int, dict[str, Synapses]] | None = None

    def inputs(self, observation: Tensor, generator: torch.Generator) -> Tensor:
        """Encoded inputs ``[S, B, ...]`` in the products' dtype and layout for raw observations ``[B, ...]``."""
        network = self._network
        if network.config.encoding == "direct" and observation.dtype == torch.uint8 and observation.dim() == 4:
            return scaled_images(observation, network.observation.scale, self._dtype).unsqueeze(0)
        x = network.encode(observation, generator)
        flat = _channels_last(x.flatten(0, 1).to(self._dtype))
        return cast(Tensor, flat.unflatten(0, x.shape[:2]))

    def synapses(self) -> dict[str, Synapses]:
        """All layers' synapses as they are now, by layer name; those of a network without gradients are kept."""
        version = sum(parameter._version for parameter in self._network.parameters())
        if self._frozen is not None and self._frozen[0] == version:
            return self._frozen[1]
        layers = {**self._network.trunk, **self._network.streams}
        synapses = {name: self._rounded(cast(TrunkLayer | Stream, layer)) for name, layer in layers.items()}
        if not any(parameter.requires_grad for parameter in self._network.parameters()):
            self._frozen = version, synapses
        return synapses

    def _rounded(self, owner: TrunkLayer | Stream) -> Synapses:
        layer: nn.Module = owner.synapses[-1] if isinstance(owner.synapses, nn.Sequential) else owner.synapses
        weight, bias = (cast(Tensor, parameter).to(self._dtype) for parameter in (layer.weight, layer.bias))
        return Synapses(_channels_last(weight), bias, layer.stride[0] if isinstance(layer, nn.Conv2d) else 0)

    def decide(self, x: Tensor, context: Context, synapses: dict[str, Synapses], training: bool) -> Tensor:
        """Q-values ``[B, A]`` of :meth:`inputs` in a task's context; normalisation as ``training`` says."""
        network, batch = self._network, x.shape[1]
        for name, layer in network.trunk.items():
            x = self._trunk_layer(cast(TrunkLayer, layer), x, context[name], synapses[name], training)
        features = x.flatten(2).flatten(0, 1)
        outputs = {}
        for name, stream in network.streams.items():
            y_TBN = F.linear(features, *synapses[name][:2]).view(-1, batch, len(synapses[name].bias))
            spikes_TBN = self._neurons.gated(y_TBN, _gain(cast(Stream, stream), context[name], y_TBN), torch.float32)
            outputs[name] = network.read_out(cast(Stream, stream), spikes_TBN)
        return network.combine(outputs)

    def _trunk_layer(
        self, layer: TrunkLayer, x: Tensor, context: tuple[Tensor, ...], synapses: Synapses, training: bool
    ) -> Tensor:
        """Spikes ``[T, B, ...]`` in the products' dtype."""
        flat = x.flatten(0, 1)
        if layer.normalization is None:
            y_SBN = F.linear(flat.flatten(1), *synapses[:2]).unflatten(0, x.shape[:2])
            return self._neurons.gated(y_SBN, torch.ones(y_SBN.shape[-1]), self._dtype)
        y: Tensor = _Convolution.apply(flat, *synapses)  # type: ignore[no-untyped-call]
        _, channels, height, width = y.shape
        y_SRC = y.permute(0, 2, 3, 1).reshape(x.shape[0], -1, channels)
        normalization, (mean_C, var_C) = layer.normalization, context
        if training:
            mean_C, var_C = batch_moments(y_SRC.detach())
            normalization.move(context, mean_C, var_C, y_SRC.shape[0] * y_SRC.shape[1])
        spikes_TRC = self._neurons.normalized(
            y_SRC,
            normalization.weight,
            normalization.bias,
            mean_C,
            (var_C + normalization.epsilon).rsqrt(),
            of_batch=training,
        )
        return spikes_TRC.view(-1, x.shape[1], height, width, channels).permute(0, 1, 4, 2, 3)


def _gain(stream: Stream, context: tuple[Tensor, ...], y_TBN: Tensor) -> Tensor:
    """The dendrites' gain of every neuron ``[N]``; 1 without dendrites."""
    if stream.dendrites is None:
        return torch.ones(y_TBN.shape[-1])
    return stream.dendrites.gains(*context).expand(y_TBN.shape[-1])


def _channels_last(x: Tensor) -> Tensor:
    return x.contiguous(memory_format=torch.channels_last) if x.dim() == 4 else x


class _Convolution(torch.autograd.Function):
    """A convolution whose two gradients are asked for one by one: together, oneDNN takes up to 1.4 times as long."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, stride: int) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.stride = stride
        return _channels_last(F.conv2d(x, weight, bias, stride))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        grad_y = _channels_last(gradients[0])

        def gradient(of_x: bool, of_weight: bool) -> tuple[Tensor, ...]:
            sizes = ([weight.shape[0]], [ctx.stride] * 2, [0, 0], [1, 1], False, [0, 0], 1)
            mask = [of_x, of_weight, of_weight]
            return torch.ops.aten.convolution_backward(grad_y, x, weight, *sizes, mask)  # type: ignore[no-any-return]

        grad_x = gradient(True, False)[0] if ctx.needs_input_grad[0] else None
        return grad_x, *gradient(False, True)[1:], None
