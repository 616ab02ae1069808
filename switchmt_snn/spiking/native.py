"""Neuron layers in C++ (``native.cpp``), for updates on a CPU: the currents' scale and shift with T steps of neurons
are one pass over memory, their gradients two; single operations take some thirty.

Shapes: S steps of the currents (T, or 1 that all steps share), T steps of the spikes, R rows, C channels.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.spiking.native_library import library, typed
from switchmt_snn.spiking.neurons import DEFAULT_SLOPE

_SURROGATES = ("atan", "fast_sigmoid")
"""Those that ``native.cpp`` has."""


class _Neuron(ctypes.Structure):
    _fields_ = (
        ("beta", ctypes.c_float),
        ("threshold", ctypes.c_float),
        ("slope", ctypes.c_float),
        ("zero", ctypes.c_int),
        ("fast_sigmoid", ctypes.c_int),
    )


def unsupported(config: NetworkConfig, spiking: bool) -> str | None:
    """The setting that ``native.cpp`` has no code for; None if there is none."""
    if not spiking:
        return f"network.method={config.method} (no spikes)"
    if config.learn_beta or config.learn_threshold:
        return "network.learn_beta or network.learn_threshold"
    if config.surrogate not in _SURROGATES:
        return f"network.surrogate={config.surrogate}"
    if config.k_winners is not None:
        return "network.k_winners"
    return "network.neuron_engine=snntorch" if config.neuron_engine == "snntorch" else None


class Spikes(NamedTuple):
    """What a layer sends to the next one."""

    numbers: Tensor
    """``[T, ..., C]`` in memory. If there are bits, only the way that gradients take: it has no memory of its own."""
    bits: Tensor | None = None
    """int32 ``[T, ..., words]``: channel c is bit c % 32 of word c // 32."""

    def with_rows(self, shape: tuple[int, ...]) -> Spikes:
        """``[T, *shape, C]`` instead of ``[T, R, C]``."""
        bits = None if self.bits is None else self.bits.unflatten(1, shape)
        return Spikes(self.numbers.unflatten(1, shape), bits)


class Currents(NamedTuple):
    """How currents come from synaptic products: ``y * scale + shift``, and what the gradient must know of it."""

    scale_C: Tensor
    shift_C: Tensor
    center_C: Tensor
    """The batch's mean; 0 without normalisation."""
    inverse_std_C: Tensor | None
    """Of the batch; None if scale and shift do not depend on it."""


class Neurons:
    """T steps of a network's neurons on synaptic products ``[S, R, C]``, floats or bfloat16.

    Spikes are those of :class:`~switchmt_snn.spiking.neurons.SpikingLayer` for the same currents.
    """

    def __init__(self, config: NetworkConfig) -> None:
        """Raises ValueError for what :func:`unsupported` names."""
        if (setting := unsupported(config, spiking=True)) is not None:
            raise ValueError(f"the native engine has no code for {setting}; use another engine")
        slope = DEFAULT_SLOPE[config.surrogate] if config.surrogate_slope is None else config.surrogate_slope
        beta = 1.0 if config.neuron == "IF" else min(max(config.beta, 0.0), 1.0)
        fast_sigmoid = config.surrogate == "fast_sigmoid"
        self._neuron = _Neuron(beta, config.threshold, slope, config.reset == "zero", fast_sigmoid)
        self.timesteps = config.timesteps

    def gated(self, y_SRC: Tensor, gain_C: Tensor, dtype: torch.dtype) -> Spikes:
        """Spikes for currents ``y * gain``; ``dtype`` as for :meth:`fire`."""
        return self._spikes(y_SRC, gain_C.contiguous(), torch.zeros(y_SRC.shape[-1]), None, None, dtype)

    def normalized(
        self,
        y_SRC: Tensor,
        weight_C: Tensor,
        bias_C: Tensor,
        mean_C: Tensor,
        inverse_std_C: Tensor,
        of_batch: bool,
        dtype: torch.dtype,
    ) -> Spikes:
        """Spikes for currents ``(y - mean) * inverse_std * weight + bias``; ``dtype`` as for :meth:`fire`.

        ``of_batch``: mean and deviation are those of ``y`` itself, and the gradient goes through them; else there is no
        gradient.
        """
        if of_batch:
            return self._spikes(y_SRC, weight_C, bias_C, mean_C, inverse_std_C, dtype)
        scale_C = weight_C.detach() * inverse_std_C
        return self._spikes(y_SRC.detach(), scale_C, bias_C.detach() - mean_C * scale_C, None, None, dtype)

    def _spikes(
        self,
        y_SRC: Tensor,
        a_C: Tensor,
        b_C: Tensor,
        mean_C: Tensor | None,
        inverse_std_C: Tensor | None,
        dtype: torch.dtype,
    ) -> Spikes:
        what = (y_SRC, a_C, b_C, mean_C, inverse_std_C, self, dtype)
        return Spikes(*_Spikes.apply(*what))  # type: ignore[no-untyped-call]

    def fire(self, y_SRC: Tensor, scale_C: Tensor, shift_C: Tensor, dtype: torch.dtype) -> Tensor:
        """Spikes ``[T, R, C]`` of currents ``y * scale + shift``, without gradient; as bits if ``dtype`` is int32:
        ``[T, R, words]``, channel c being bit c % 32 of word c // 32.

        Raises:
            ValueError: ``y`` is not contiguous, has neither 1 nor T steps, or a dtype that does not go with ``dtype``;
                scale or shift are not contiguous float32.
        """
        steps, rows, channels = y_SRC.shape
        for numbers_C in (scale_C, shift_C):
            if numbers_C.dtype != torch.float32 or numbers_C.shape != (channels,) or not numbers_C.is_contiguous():
                raise ValueError(
                    f"{numbers_C.dtype} {tuple(numbers_C.shape)}, expected float32 for {channels} channels"
                )
        fitting = dtype in (torch.float32, torch.int32, y_SRC.dtype)
        if not y_SRC.is_contiguous() or steps not in (1, self.timesteps) or not fitting:
            raise ValueError(
                f"{y_SRC.dtype} {tuple(y_SRC.shape)} with strides {y_SRC.stride()} for spikes in {dtype}, expected "
                f"contiguous currents of 1 or {self.timesteps} steps, and spikes in float32 or the currents' dtype"
            )
        as_bits = dtype == torch.int32
        spikes = torch.empty(self.timesteps, rows, -(-channels // 32) if as_bits else channels, dtype=dtype)
        currents = (*typed(y_SRC), _step(y_SRC), scale_C.data_ptr(), shift_C.data_ptr())
        where = (spikes.data_ptr(),) if as_bits else typed(spikes)
        fire = library().snn_fire_bits if as_bits else library().snn_fire
        sizes = (self.timesteps, rows, channels, torch.get_num_threads())
        fire(ctypes.addressof(self._neuron), *currents, *where, *sizes)
        return spikes

    def unfire(self, y_SRC: Tensor, currents: Currents, grad_TRC: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient of the currents ``[S, R, C]``, and the sums ``[2, C]`` of it and of it times ``y - center``."""
        steps, rows, channels = y_SRC.shape
        grad_SRC = torch.empty(steps, rows, channels)
        sums_2C = torch.zeros(2, channels, dtype=torch.float64)
        if not (grad_TRC.stride(0) == 0 and grad_TRC[0].is_contiguous()):
            grad_TRC = grad_TRC.contiguous()
        library().snn_unfire(
            ctypes.addressof(self._neuron),
            *typed(y_SRC),
            _step(y_SRC),
            currents.scale_C.data_ptr(),
            currents.shift_C.data_ptr(),
            currents.center_C.data_ptr(),
            *typed(grad_TRC),
            grad_TRC.stride(0),
            grad_SRC.data_ptr(),
            sums_2C.data_ptr(),
            self.timesteps,
            rows,
            channels,
            torch.get_num_threads(),
        )
        return grad_SRC, sums_2C.to(torch.float32)


def batch_moments(y_SRC: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and biased variance of every channel ``[C]`` over steps and rows."""
    y_SRC = y_SRC.contiguous()
    steps, rows, channels = y_SRC.shape
    mean_C, variance_C = torch.empty(channels), torch.empty(channels)
    library().snn_moments(
        *typed(y_SRC), mean_C.data_ptr(), variance_C.data_ptr(), steps * rows, channels, torch.get_num_threads()
    )
    return mean_C, variance_C


def scaled_images(x_BCHW: Tensor, scale: float, dtype: torch.dtype) -> Tensor:
    """Images of bytes times ``scale``, rounded to a dtype: ``[B, C, H, W]`` with channels innermost in memory."""
    batch, channels, height, width = x_BCHW.shape
    x_BCHW = x_BCHW.contiguous()
    out_BHWC = torch.empty(batch, height, width, channels, dtype=dtype)
    library().snn_images(
        x_BCHW.data_ptr(), scale, *typed(out_BHWC), batch, channels, height * width, torch.get_num_threads()
    )
    return out_BHWC.permute(0, 3, 1, 2)


class _Spikes(torch.autograd.Function):
    """Spikes of ``y * scale + shift``; with ``inverse_std``, a and b are a normalisation's weight and bias."""

    @staticmethod
    def forward(
        ctx: Any,
        y_SRC: Tensor,
        a_C: Tensor,
        b_C: Tensor,
        mean_C: Tensor | None,
        inverse_std_C: Tensor | None,
        neurons: Neurons,
        dtype: torch.dtype,
    ) -> tuple[Tensor, Tensor | None]:
        if mean_C is None or inverse_std_C is None:
            currents = Currents(a_C, b_C, torch.zeros_like(b_C), None)
        else:
            scale_C = a_C * inverse_std_C
            currents = Currents(scale_C, b_C - mean_C * scale_C, mean_C, inverse_std_C)
        ctx.save_for_backward(y_SRC, *currents)
        ctx.neurons = neurons
        spikes = neurons.fire(y_SRC, currents.scale_C, currents.shift_C, dtype)
        if dtype != torch.int32:
            return spikes, None
        return torch.zeros((), dtype=y_SRC.dtype).expand(neurons.timesteps, *y_SRC.shape[1:]), spikes

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        y_SRC, *kept = ctx.saved_tensors
        currents = Currents(*kept)
        grad_SRC, (sum_C, product_C) = ctx.neurons.unfire(y_SRC, currents, gradients[0])
        if currents.inverse_std_C is None:  # product_C: the center is 0
            slope_C = constant_C = torch.zeros_like(sum_C)
            grad_a_C = product_C
        else:  # the batch's mean and deviation follow y
            count = y_SRC.numel() // y_SRC.shape[-1]
            grad_a_C = product_C * currents.inverse_std_C
            slope_C = currents.scale_C * currents.inverse_std_C * grad_a_C / -count
            constant_C = currents.scale_C * sum_C / -count
        grad_y_SRC = torch.empty_like(y_SRC)
        library().snn_combine(
            grad_SRC.data_ptr(),
            *typed(y_SRC),
            currents.scale_C.data_ptr(),
            currents.center_C.data_ptr(),
            slope_C.data_ptr(),
            constant_C.data_ptr(),
            grad_y_SRC.data_ptr(),
            y_SRC.shape[0] * y_SRC.shape[1],
            y_SRC.shape[2],
            torch.get_num_threads(),
        )
        return grad_y_SRC, grad_a_C, sum_C, None, None, None, None


def _step(y_SRC: Tensor) -> int:
    return y_SRC.stride(0) if y_SRC.shape[0] > 1 else 0
