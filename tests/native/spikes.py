"""Random spikes, and their bits, packed by PyTorch's operations."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def random_spikes(*shape: int, rate: float = 0.3) -> Tensor:
    return (torch.rand(*shape) < rate).float()


def as_bits(spikes: Tensor) -> Tensor:
    """int32 words of 32 channels each, the last dimension being channels."""
    missing = -spikes.shape[-1] % 32
    words = (F.pad(spikes, (0, missing)).unflatten(-1, (-1, 32)).long() << torch.arange(32)).sum(-1)
    return torch.where(words >= 2**31, words - 2**32, words).to(torch.int32)
