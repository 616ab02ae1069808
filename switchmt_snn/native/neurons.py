"""Neuron layers in C++ (``csrc/neurons.cpp``): one pass over memory scales and shifts the products and runs T steps of
neurons on them. Their backward takes two passes; PyTorch's single operations take some thirty.

Shapes: S steps of the currents (T, or 1 that all steps share), T steps of the spikes, R rows (batch times positions),
C channels.
"""

from __future__ import annotations

import ctypes
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.native import supports
from switchmt_snn.native.library import library
from switchmt_snn.native.pointers import BYTES, FLOAT32, pointer, typed_pointer
from switchmt_snn.spiking.neurons import DEFAULT_SLOPE

Form = Literal["dense", "float32", "bits", "mean"]
"""How spikes ``[T, R, C]`` are kept.

- ``dense``: values 0 and 1 in the dtype of the currents.
- ``float32``: the same in float32.
- ``bits``: int32 words ``[T, R, words]``; channel c is bit c % 32 of word c // 32.
- ``mean``: their mean over the steps ``[1, R, C]``, float32.
"""


class _Neuron(ctypes.Structure):
    """``struct Neuron`` of ``csrc/neurons.cpp``."""

    _fields_ = (
        ("beta", ctypes.c_float),
        ("threshold", ctypes.c_float),
        ("slope", ctypes.c_float),
        ("resets_to_zero", ctypes.c_int),
        ("is_fast_sigmoid", ctypes.c_int),
    )


class Spikes(NamedTuple):
    """What a layer sends to the next one."""

    values: Tensor
    """Dense values ``[T, ..., C]``; or int32 words ``[T, ..., words]``, see ``Form``."""
    channels: int
    is_bits: bool = False


class Currents(NamedTuple):
    """How currents come from synaptic products: ``(y - mean) / sqrt(variance + epsilon) * a + b``, or ``y * a``."""

    a_C: Tensor
    b_C: Tensor | None = None
    mean_C: Tensor | None = None
    variance_C: Tensor | None = None
    epsilon: float = 0.0

    def pointers(self, channels: int) -> list[int | None]:
        """Of the four tensors.

        Raises:
            ValueError: one is not contiguous float32 ``[C]``.
        """
        return [None if x is None else pointer(x, FLOAT32, (channels,)) for x in self[:4]]


class Neurons:
    """T steps of a network's neurons on synaptic products ``[S, R, C]``, float32 or bfloat16.

    Spikes are bitwise those of ``LeakyLayer`` for the same currents.
    """

    def __init__(self, config: NetworkConfig) -> None:
        """Raises ConfigError for a setting that ``supports`` does not name."""
        supports.require_setting(config)
        slope = DEFAULT_SLOPE[config.surrogate] if config.surrogate_slope is None else config.surrogate_slope
        beta = 1.0 if config.neuron == "IF" else min(max(config.beta, 0.0), 1.0)
        is_fast_sigmoid = config.surrogate == "fast_sigmoid"
        self._neuron = _Neuron(beta, config.threshold, slope, config.reset == "zero", is_fast_sigmoid)
        self.timesteps = config.timesteps

    def fire(self, y_SRC: Tensor, currents: Currents, form: Form) -> tuple[Tensor, Tensor]:
        """Spikes; and the currents' scale, shift, mean and inverse deviation ``[4, C]``, which the backward needs.

        Raises:
            ValueError: ``y`` is not contiguous float32 or bfloat16 of 1 or T steps; see also ``Currents.pointers``.
        """
        steps, rows, channels = y_SRC.shape
        if steps not in (1, self.timesteps):
            raise ValueError(f"currents {tuple(y_SRC.shape)}, expected 1 or {self.timesteps} steps")
        currents_4C = torch.empty(4, channels)
        arguments = (
            ctypes.addressof(self._neuron),
            *typed_pointer(y_SRC),
            _step_stride(y_SRC),
            *currents.pointers(channels),
            currents.epsilon,
            currents_4C.data_ptr(),
        )
        sizes = (self.timesteps, rows, channels, torch.get_num_threads())
        if form == "bits":
            spikes = torch.empty(self.timesteps, rows, -(-channels // 32), dtype=torch.int32)
            library().snn_fire_bits(*arguments, spikes.data_ptr(), *sizes)
        elif form == "mean":
            spikes = torch.empty(1, rows, channels)
            library().snn_fire_mean(*arguments, spikes.data_ptr(), *sizes)
        elif form in ("dense", "float32"):
            dtype = torch.float32 if form == "float32" else y_SRC.dtype
            spikes = torch.empty(self.timesteps, rows, channels, dtype=dtype)
            library().snn_fire(*arguments, *typed_pointer(spikes), *sizes)
        else:
            raise ValueError(f"form {form!r}, expected dense, float32, bits or mean")
        return spikes, currents_4C

    def fire_backward(self, y_SRC: Tensor, currents_4C: Tensor, grad_TRC: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of ``y``, and ``[2, C]`` of the currents' a and b, from those of the spikes.

        If the currents had moments, these are taken for those of ``y``, and the gradient goes through them.

        Raises:
            ValueError: ``y`` or ``currents_4C`` are not those of ``fire``, or the gradient is not one of T steps,
                in float32 or the dtype of ``y``.
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
        library().snn_fire_backward(
            ctypes.addressof(self._neuron),
            *typed_pointer(y_SRC),
            _step_stride(y_SRC),
            pointer(currents_4C, FLOAT32, (4, channels)),
            *typed_pointer(grad_TRC[0]),
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

    A running mean and (unbiased) variance, if given, move towards them, as in
    ``move``.

    Raises:
        ValueError: running ones are not contiguous float32 ``[C]``, or a single row has no variance to follow.
    """
    y_SRC = y_SRC.contiguous()
    steps, rows, channels = y_SRC.shape
    if running is not None and steps * rows < 2:
        raise ValueError("one row, expected two or more for a variance to follow")
    mean_C, variance_C = torch.empty(channels), torch.empty(channels)
    followers = [None, None] if running is None else [pointer(x, FLOAT32, (channels,)) for x in running]
    sizes = (steps * rows, channels, torch.get_num_threads())
    library().snn_moments(*typed_pointer(y_SRC), mean_C.data_ptr(), variance_C.data_ptr(), *followers, momentum, *sizes)
    return mean_C, variance_C


def scaled_images(x_BCHW: Tensor, scale: float, dtype: torch.dtype) -> Tensor:
    """Images of bytes times ``scale``, rounded to a dtype: ``[B, C, H, W]`` with channels innermost in memory."""
    batch, channels, height, width = x_BCHW.shape
    x_BCHW = x_BCHW.contiguous()
    out_BHWC = torch.empty(batch, height, width, channels, dtype=dtype)
    sizes = (batch, channels, height * width, torch.get_num_threads())
    library().snn_scale_images(pointer(x_BCHW, BYTES), scale, *typed_pointer(out_BHWC), *sizes)
    return out_BHWC.permute(0, 3, 1, 2)


def _step_stride(y_SRC: Tensor) -> int:
    """Values from one step to the next; 0 if all steps share one."""
    return y_SRC.stride(0) if y_SRC.shape[0] > 1 else 0
