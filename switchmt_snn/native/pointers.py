"""Checked pointers to tensors for C++, which cannot see a tensor's dtype, shape and layout."""

from __future__ import annotations

import torch
from torch import Tensor

FLOAT32 = (torch.float32,)
BFLOAT16 = (torch.bfloat16,)
FLOATS = (torch.float32, torch.bfloat16)
WORDS = (torch.int32,)
BYTES = (torch.uint8,)


def pointer(x: Tensor, dtypes: tuple[torch.dtype, ...], shape: tuple[int | None, ...] | None = None) -> int:
    """The address of a tensor's first value.

    Args:
        x: a tensor that stays alive until C++ returns.
        dtypes: those that the C++ function reads.
        shape: that it reads, None for any size of a dimension; None for any shape.

    Raises:
        ValueError: the tensor has another dtype or shape, is not contiguous, or is not on the CPU.
    """
    fits = shape is None or (
        x.dim() == len(shape) and all(wanted in (None, size) for wanted, size in zip(shape, x.shape, strict=True))
    )
    if fits and x.dtype in dtypes and x.is_cpu and x.is_contiguous():
        return x.data_ptr()
    names = " or ".join(str(dtype).removeprefix("torch.") for dtype in dtypes)
    sizes = "" if shape is None else f" [{', '.join('*' if size is None else str(size) for size in shape)}]"
    raise ValueError(
        f"{x.dtype} {tuple(x.shape)} with strides {x.stride()} on {x.device}, expected contiguous {names}{sizes} on "
        "the CPU"
    )


def typed_pointer(x: Tensor, shape: tuple[int | None, ...] | None = None) -> tuple[int, int]:
    """``pointer`` of a float32 or bfloat16 tensor, and 1 if it is bfloat16: the pair of arguments of C++ functions
    that read both."""
    return pointer(x, FLOATS, shape), int(x.dtype == torch.bfloat16)
