"""Neuron layers in C++ (``native.cpp``), for updates on a CPU: the currents' scale and shift with T steps of neurons
are one pass over memory, their gradients two; single operations take some thirty.

Shapes: S steps of the currents (T, or 1 that all steps share), T steps of the spikes, R rows, C channels.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.native.library import library, typed
from switchmt_snn.spiking.neurons import DEFAULT_SLOPE

Form = Literal["numbers", "floats", "bits", "mean"]
"""Of spikes ``[T, R, C]``: numbers of the currents' dtype, or float32; int32 words ``[T, R, words]``, channel c being
bit c % 32 of word c // 32; their mean over the steps ``[1, R, C]``, float32."""

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
    if config.neuron not in ("IF", "LIF"):
        return f"network.neuron={config.neuron}"
    if config.surrogate not in _SURROGATES:
        return f"network.surrogate={config.surrogate}"
    if config.k_winners is not None:
        return "network.k_winners"
    return "network.neuron_engine=snntorch" if config.neuron_engine == "snntorch" else None


class Spikes(NamedTuple):
    """What a layer sends to the next one."""

    memory: Tensor
    """Numbers ``[T, ..., C]``; or int32 words ``[T, ..., words]``, channel c being bit c % 32 of word c // 32."""
    channels: int
    is_bits: bool = False


class Currents(NamedTuple):
    """How currents come from synaptic products: ``(y - mean) / sqrt(variance + epsilon) * a + b``, or ``y * a``."""

    a_C: Tensor
    b_C: Tensor | None = None
    mean_C: Tensor | None = None
    variance_C: Tensor | None = None
    epsilon: float = 0.0

    def places(self, channels: int) -> list[int | None]:
        """Where they lie; see :func:`_places`."""
        return _places(self[:4], channels)


class Neurons:
    """T steps of a network's neurons on synaptic products ``[S, R, C]``, floats or bfloat16.

    Spikes are those of :class:`~switchmt_snn.spiking.neurons.LeakyLayer` for the same currents.
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

    def fire(self, y_SRC: Tensor, currents: Currents, form: Form) -> tuple[Tensor, Tensor]:
        """Spikes; and the currents' scale, shift, mean and inverse deviation ``[4, C]``, which the gradient needs.

        Raises:
            ValueError: ``y`` is not contiguous float32 or bfloat16 of 1 or T steps; see :meth:`Currents.places`.
        """
        steps, rows, channels = y_SRC.shape
        if not y_SRC.is_contiguous() or steps not in (1, self.timesteps):
            raise ValueError(
                f"{y_SRC.dtype} {tuple(y_SRC.shape)} with strides {y_SRC.stride()}, expected contiguous currents of 1 "
                f"or {self.timesteps} steps"
            )
        currents_4C, places = torch.empty(4, channels), currents.places(channels)
        what = (ctypes.addressof(self._neuron), *typed(y_SRC), _step(y_SRC), *places, currents.epsilon)
        what += (currents_4C.data_ptr(),)
        sizes = (self.timesteps, rows, channels, torch.get_num_threads())
        if form == "bits":
            spikes = torch.empty(self.timesteps, rows, -(-channels // 32), dtype=torch.int32)
            library().snn_fire_bits(*what, spikes.data_ptr(), *sizes)
        elif form == "mean":
            spikes = torch.empty(1, rows, channels)
            library().snn_fire_mean(*what, spikes.data_ptr(), *sizes)
        else:
            dtype = torch.float32 if form == "floats" else y_SRC.dtype
            spikes = torch.empty(self.timesteps, rows, channels, dtype=dtype)
            library().snn_fire(*what, *typed(spikes), *sizes)
        return spikes, currents_4C

    def unfire(self, y_SRC: Tensor, currents_4C: Tensor, grad_TRC: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of ``y``, and ``[2, C]`` of the currents' a and b, from those of the spikes.

        Moments that the currents had are those of ``y``, and the gradient goes through them.

        Raises:
            ValueError: the gradient is not one of T steps, in float32 or the dtype of ``y``.
        """
        steps, rows, channels = y_SRC.shape
        if grad_TRC.shape != (self.timesteps, rows, channels) or grad_TRC.dtype not in (torch.float32, y_SRC.dtype):
            raise ValueError(
                f"gradient {grad_TRC.dtype} {tuple(grad_TRC.shape)}, expected float32 or {y_SRC.dtype} "
                f"{(self.timesteps, rows, channels)}"
            )
        scratch_SRC, grad_y_SRC = torch.empty(steps, rows, channels), torch.empty_like(y_SRC)
        grad_2C = torch.empty(2, channels)
        if not (grad_TRC.stride(0) == 0 and grad_TRC[0].is_contiguous()):
            grad_TRC = grad_TRC.contiguous()
        library().snn_unfire(
            ctypes.addressof(self._neuron),
            *typed(y_SRC),
            _step(y_SRC),
            currents_4C.data_ptr(),
            *typed(grad_TRC),
            grad_TRC.stride(0),
            scratch_SRC.data_ptr(),
            grad_y_SRC.data_ptr(),
            grad_2C.data_ptr(),
            self.timesteps,
            rows,
            channels,
            torch.get_num_threads(),
        )
        return grad_y_SRC, grad_2C


def batch_moments(
    y_SRC: Tensor, running: tuple[Tensor, Tensor] | None = None, momentum: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Mean and biased variance of every channel ``[C]`` over steps and rows.

    A running mean and (unbiased) variance move towards them, as those of
    :meth:`~switchmt_snn.spiking.normalization.TaskBatchNorm.move` do.

    Raises:
        ValueError: running ones are not those of the channels (:func:`_places`), or there is a single row, which has no
            variance to follow.
    """
    y_SRC = y_SRC.contiguous()
    steps, rows, channels = y_SRC.shape
    if running is not None and steps * rows < 2:
        raise ValueError("one row, expected two or more for a variance to follow")
    mean_C, variance_C = torch.empty(channels), torch.empty(channels)
    places = _places((mean_C, variance_C, *(running or (None, None))), channels)
    library().snn_moments(*typed(y_SRC), *places, momentum, steps * rows, channels, torch.get_num_threads())
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


def _places(numbers_C: Iterable[Tensor | None], channels: int) -> list[int | None]:
    """Where numbers of channels lie.

    Raises:
        ValueError: something is not contiguous float32 for every channel.
    """
    places: list[int | None] = []
    for x in numbers_C:
        if x is None:
            places.append(None)
            continue
        if x.dtype != torch.float32 or x.shape != (channels,) or not x.is_contiguous():
            raise ValueError(f"{x.dtype} {tuple(x.shape)}, expected float32 for {channels} channels")
        places.append(x.data_ptr())
    return places


def _step(y_SRC: Tensor) -> int:
    return y_SRC.stride(0) if y_SRC.shape[0] > 1 else 0
