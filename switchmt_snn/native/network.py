"""A network's decision in C++: the same function as ``QNetwork.decide``, with its backward written by hand.

Synaptic products are in ``switchmt_snn.native.products``, neurons in ``switchmt_snn.native.neurons``; channels
are innermost in memory. For autograd, everything from the encoded inputs to the heads' outputs is one operation.
``native/README.md`` draws both directions side by side.

Shapes: S steps of an input (T, or 1 that all steps share), T simulation steps, B batch, R rows, C channels, N neurons
of all streams, A actions, M quantiles, O outputs of the heads (one per quantile and action).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from switchmt_snn.native import supports
from switchmt_snn.native.neurons import Currents, Form, Neurons, Spikes, batch_moments, scaled_images
from switchmt_snn.native.products import Gradients, Synapses, connected, convolved
from switchmt_snn.native.streams import Gains, HeadMatrix, Heads
from switchmt_snn.native.supports import spikes_as_bits
from switchmt_snn.spiking.network import Context, QNetwork, Stream, TrunkLayer

Backward = Callable[[Tensor], list[Tensor]]
"""From the gradient of the heads' outputs to those of ``NativeNetwork._differentiated``."""


_FEW_LANES = 32
"""T * B up to which dense products of the streams are faster than those of bits (16 lanes: 0.6 and 3.0 ms)."""


Statistics = Literal["running", "batch", "moving"]
"""What BatchNorm normalizes by: the running statistics, the batch's, or the batch's while the running ones move."""


class TaskParameters(NamedTuple):
    """What a task changes in a network; valid until the network's parameters change."""

    task: int
    gain_N: Tensor
    """Gains of the dendrites of all streams, one stream after the other."""
    heads: HeadMatrix
    context: Context


class NativeNetwork:
    """Q-values of a network whose parameters are read at every call.

    With ``torch.bfloat16``, weights, synaptic products and the gradients of products and inputs are rounded to it, as
    under autocast. Biases and the gradients of weights are not, except in PyTorch's products. Everything else is
    float32, and everything is on the CPU. A change of parameters through ``.data`` is not seen.

    Attributes:
        copies: what products read instead of parameters, by parameter; those of images have channels innermost.
    """

    def __init__(self, network: QNetwork, precision: torch.dtype | None) -> None:
        """Raises ConfigError for a network that ``switchmt_snn.native.supports`` refuses."""
        supports.require(network)
        self._network = network
        self._parameters = list(network.parameters())
        self._dtype = torch.float32 if precision is None else precision
        form: Form = "bits" if spikes_as_bits(self._dtype) else "dense"
        neurons = self._neurons = Neurons(network.config)
        self._is_mean = network.config.readout == "mean"
        self._last_form: Form = "mean" if self._is_mean else "float32"
        self._trunk = {
            name: _Layer(cast(TrunkLayer, layer), self._dtype, neurons, form) for name, layer in network.trunk.items()
        }
        streams = [cast(Stream, stream) for stream in network.streams.values()]
        self._streams = Synapses([stream.synapses for stream in streams], self._dtype)
        self._gains = Gains(streams)
        self._stream_norms = [stream.normalization for stream in streams if stream.normalization is not None]
        self._synapses = [*(layer.synapses for layer in self._trunk.values()), self._streams]
        self._heads = Heads(network)
        of_trunk = [part for layer in self._trunk.values() for part in layer.parameters]
        of_streams = (*self._streams.parameters, *self._gains.parameters, *self._heads.parameters)
        self._differentiated = (*of_trunk, *of_streams)
        self.copies = {part: copy for synapses in self._synapses for part, copy in synapses.copies.items()}
        self._copied_version = self._version = -1
        self._by_task: dict[int, TaskParameters] = {}
        self._contexts: dict[int, Context] = {}

    def inputs(self, observation: Tensor, generator: torch.Generator) -> Tensor:
        """Encoded inputs ``[S, B, H, W, C]`` or ``[S, B, C]`` in the products' dtype for raw observations."""
        network = self._network
        if network.config.encoding == "direct" and observation.dtype == torch.uint8 and observation.dim() == 4:
            images = scaled_images(observation, network.observation.scale, self._dtype)
            return images.permute(0, 2, 3, 1).unsqueeze(0)
        x = network.encode(observation, generator).to(self._dtype)
        return x.movedim(2, -1).contiguous()

    def copies_are_current(self) -> bool:
        """Whether all ``copies`` equal the parameters as they are now."""
        return self._version_now() == self._copied_version

    def mark_copies_current(self) -> None:
        """Call this after updating parameters *and* their copies; otherwise the next ``for_task`` copies anew."""
        self._copied_version = self._version_now()

    def _version_now(self) -> int:
        return sum(parameter._version for parameter in self._parameters)

    def for_task(self, task: int) -> TaskParameters:
        """What ``decide`` needs for a task, from the parameters as they are now.

        Raises:
            IndexError: unknown task.
        """
        version = self._version_now()
        if version != self._version:
            if version != self._copied_version:
                for synapses in self._synapses:
                    synapses.read()
            self._copied_version = self._version = version
            self._by_task = {}
        if task not in self._by_task:
            gain_N = self._gains.of_task(task)
            if task not in self._contexts:
                self._contexts[task] = self._network.context(task)  # views, which see changes
            self._by_task[task] = TaskParameters(task, gain_N, self._heads.of_task(task), self._contexts[task])
        return self._by_task[task]

    def act(self, x: Tensor, parameters: TaskParameters) -> Tensor:
        """Q-values ``[B, A]`` in eval mode, without a gradient; ``decide`` for the few observations of a step.

        The trunk's last spikes are dense if they are few, because a panel of bits has 64 lanes, filled or not.

        Args:
            x: of ``inputs``.
            parameters: of ``for_task``.
        """
        dense: Form | None = "dense" if self._neurons.timesteps * x.shape[1] <= _FEW_LANES else None
        with torch.no_grad():
            features = self._features(x, parameters, "running", last=dense)
            (y_TBN,), _ = connected([features], self._streams)
            currents = self._stream_currents(y_TBN, parameters, "running")
            spikes_SBN, _ = self._neurons.fire(y_TBN, currents, self._last_form)
            output_SBA = parameters.heads.means(spikes_SBN)
        return self._over_steps(output_SBA[0] if self._is_mean else output_SBA)

    def decide(
        self,
        x: Tensor,
        parameters: TaskParameters,
        training: bool,
        other_inputs: Sequence[Tensor] = (),
        statistics: Statistics = "running",
    ) -> list[Tensor]:
        """Values of several inputs at once, which shares products with the streams' weights.

        Args:
            x: of ``inputs``; if ``training``, normalized by the batch, and then its values have a gradient.
            parameters: of ``for_task``.
            training: see ``x``.
            other_inputs: of ``inputs``; their Q-values have no gradient.
            statistics: what normalizes all but a training ``x``.

        Returns:
            ``[B, A]``, or ``[B, M, A]`` with several quantiles, for ``x``; Q-values ``[B, A]`` for each other input.
        """
        if training and torch.is_grad_enabled():
            outputs = _Decision.apply(self, x, parameters, other_inputs, statistics, *self._differentiated)  # type: ignore[no-untyped-call, unused-ignore]
        else:
            of_x: Statistics = "moving" if training else statistics
            with torch.no_grad():
                outputs, _ = self._outputs(x, parameters, of_x, other_inputs, statistics, None)
        values, *others = (self._over_steps(output) for output in outputs)
        quantiles = self._network.config.quantiles
        return [values if quantiles == 1 else values.unflatten(-1, (quantiles, -1)), *others]

    def _over_steps(self, output: Tensor) -> Tensor:
        """``[B, O]`` of a head's output ``[B, O]`` (``mean`` readout) or ``[T, B, O]``."""
        if self._is_mean:
            return output
        readout = self._network.readout
        return readout.q_values(readout.integrate(output))

    def _outputs(
        self,
        x: Tensor,
        parameters: TaskParameters,
        of_x: Statistics,
        other_inputs: Sequence[Tensor],
        of_others: Statistics,
        layers: list[Gradients] | None,
    ) -> tuple[list[Tensor], Backward]:
        """Outputs of the heads, ``[B, O]`` (``mean`` readout) or ``[T, B, O]``, and the backward of the first ones.

        Those of other inputs are means over quantiles.

        Each trunk layer's backward is appended to ``layers``, which the returned function empties from the end.
        """
        # Others first: training moves the running statistics.
        others = [self._features(other, parameters, of_others) for other in other_inputs]
        ys, of_streams = connected([self._features(x, parameters, of_x, layers), *others], self._streams)
        # Others first here, too.
        currents = [self._stream_currents(y_TBN, parameters, of_others) for y_TBN in ys[1:]]
        currents = [self._stream_currents(ys[0], parameters, of_x), *currents]
        fired = [self._neurons.fire(y, current, self._last_form) for y, current in zip(ys, currents, strict=True)]
        # The backward keeps only the first input's activations alive, and not its own outputs.
        y_TBN, (spikes_SBN, currents_4N), heads = ys[0], fired[0], parameters.heads
        outputs = [heads.outputs(spikes_SBN), *(heads.means(other_SBN) for other_SBN, _ in fired[1:])]
        shape = outputs[0].shape
        task, version = parameters.task, self._version

        def backward(grad: Tensor) -> list[Tensor]:
            if not layers:
                raise RuntimeError("a second backward, expected one for each decision")
            if self._version_now() != version:
                raise RuntimeError("parameters have changed since the decision, expected its backward first")
            steps, grad_SBO = self._neurons.timesteps, grad.contiguous().view(shape)
            scale = 1.0 / steps if self._is_mean else 1.0
            grad_SBN, of_heads = self._heads.gradients(spikes_SBN, grad_SBO, scale, heads)
            grad_TBN = grad_SBN.expand(steps, -1, -1)
            grad_y, (grad_gain_N, grad_shift_N) = self._neurons.fire_backward(y_TBN, currents_4N, grad_TBN)
            if self._stream_norms:  # the gain scales the normalized current, and its constant shift
                grad_gain_N = (grad_gain_N + grad_shift_N) * self._stream_norms[0].weight[0]
            of_gains = self._gains.gradients(task, grad_gain_N)
            grad_x, of_synapses = of_streams(grad_y, True)
            parts = [*of_synapses, *of_gains, *of_heads]
            while layers:  # frees what each layer saved
                layer_backward = layers.pop()
                grad_x, of_layer = layer_backward(cast(Tensor, grad_x), bool(layers))
                parts = [*of_layer, *parts]
            return parts

        return [output_SBO[0] if self._is_mean else output_SBO for output_SBO in outputs], backward

    def _stream_currents(self, y_TBN: Tensor, parameters: TaskParameters, statistics: Statistics) -> Currents:
        """How the streams' currents come from their products: the gain, of the normalized product if that is set."""
        if not self._stream_norms:
            return Currents(parameters.gain_N)
        norms, task, gain_N = self._stream_norms, parameters.task, parameters.gain_N
        # Copies: streams have statistics of their own, and moving those must not change what other inputs read.
        mean_N, variance_N = (
            torch.cat(parts) for parts in zip(*(norm.statistics(task) for norm in norms), strict=True)
        )
        if statistics == "batch":
            mean_N, variance_N = batch_moments(y_TBN)
        elif statistics == "moving":
            moved = mean_N, variance_N
            mean_N, variance_N = batch_moments(y_TBN, moved, norms[0].momentum)
            sizes = [len(norm.weight) for norm in norms]
            for norm, *parts in zip(norms, *(values_N.split(sizes) for values_N in moved), strict=True):
                for held, part in zip(norm.statistics(task), parts, strict=True):
                    held.copy_(part)
        scale_N = gain_N * norms[0].weight[0]  # weight and bias are one constant
        return Currents(scale_N, scale_N, mean_N, variance_N, norms[0].epsilon)

    def _features(
        self,
        x: Tensor,
        parameters: TaskParameters,
        statistics: Statistics,
        layers: list[Gradients] | None = None,
        last: Form | None = None,
    ) -> Spikes:
        """What the trunk sends to the streams, in the form ``last`` if given.

        Each layer's backward is appended to ``layers``, if given.
        """
        spikes = Spikes(x, x.shape[-1])
        for number, (name, layer) in enumerate(self._trunk.items(), start=1):
            form = last if number == len(self._trunk) else None
            spikes, gradients = layer.fire(spikes, parameters.context[name], statistics, form)
            if layers is not None:
                layers.append(gradients)
        return spikes


class _Layer:
    """A layer of the trunk: products, normalisation if it has one, neurons."""

    def __init__(self, layer: TrunkLayer, dtype: torch.dtype, neurons: Neurons, form: Form) -> None:
        module = layer.synapses[-1] if isinstance(layer.synapses, nn.Sequential) else layer.synapses
        self.synapses = Synapses([cast(nn.Linear | nn.Conv2d, module)], dtype)
        self._normalization, self._neurons, self._form = layer.normalization, neurons, form
        self.parameters = self.synapses.parameters
        if self._normalization is None:
            self._currents = Currents(torch.ones(len(self.synapses.bias)))
        else:
            affine = self._normalization.weight, self._normalization.bias
            self.parameters += affine
            weight_C, bias_C = (part.detach() for part in affine)
            self._currents = Currents(weight_C, bias_C, epsilon=self._normalization.epsilon)

    def fire(
        self, x: Spikes, context: tuple[Tensor, ...], statistics: Statistics, form: Form | None = None
    ) -> tuple[Spikes, Gradients]:
        """Spikes ``[T, B, h, w, C]`` or ``[T, B, C]``; and the backward, to ``x`` and the parameters.

        ``form`` is that of the spikes; None takes the network's.
        """
        form = self._form if form is None else form
        neurons, normalization, currents = self._neurons, self._normalization, self._currents
        if self.synapses.stride:
            y, of_products = convolved(x, self.synapses)
        else:
            (y,), of_products = connected([x], self.synapses)
        y_SRC = y.flatten(1, -2)
        if normalization is not None:
            mean_C, var_C = context
            if statistics != "running":
                moved = (mean_C, var_C) if statistics == "moving" else None
                mean_C, var_C = batch_moments(y_SRC, moved, normalization.momentum)
            currents = currents._replace(mean_C=mean_C, variance_C=var_C)
        values, currents_4C = neurons.fire(y_SRC, currents, form)

        def gradients(grad: Tensor, of_inputs: bool) -> tuple[Tensor | None, list[Tensor]]:
            grad_TRC = grad.view(neurons.timesteps, *y_SRC.shape[1:])
            grad_y, grad_2C = neurons.fire_backward(y_SRC, currents_4C, grad_TRC)
            grad_x, parts = of_products(grad_y, of_inputs)
            return grad_x, parts if normalization is None else [*parts, *grad_2C]

        shape = (neurons.timesteps, *y.shape[1:-1], values.shape[-1])
        return Spikes(values.view(shape), y.shape[-1], form == "bits"), gradients


class _Decision(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        network: NativeNetwork,
        x: Tensor,
        task_parameters: TaskParameters,
        other_inputs: Sequence[Tensor],
        statistics: Statistics,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        outputs, ctx.network_backward = network._outputs(x, task_parameters, "moving", other_inputs, statistics, [])
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(*outputs[1:])
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, None, None, None, *ctx.network_backward(gradients[0])
