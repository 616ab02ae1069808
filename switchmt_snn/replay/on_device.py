"""A replay memory's frames as one tensor of bytes on the learner's device: batches are gathered where they are used."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from switchmt_snn.replay.frames import Frames, Slots

STAGED_FRAMES = 256
"""Frames that wait on the host before they are sent together."""


def to_device(array: npt.NDArray[np.generic], device: torch.device) -> Tensor:
    """An array as a tensor on a device.

    To a GPU it goes by way of a page-locked copy, so the caller neither waits nor has to keep the array; on the CPU the
    tensor is the array's memory.
    """
    tensor = torch.from_numpy(array)
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


class DeviceFrames:
    """One tensor for everything; new frames are sent a few hundred at a time, at the latest before a reading."""

    def __init__(
        self, num_lanes: int, slots: int, frame_shape: tuple[int, ...], dtype: npt.DTypeLike, device: torch.device
    ) -> None:
        self._slots, self._zero = slots, num_lanes * slots
        # Of a lane's slots none is staged twice, so the order in which they are written does not matter.
        self._staged = np.zeros((min(STAGED_FRAMES, slots), *frame_shape), dtype)
        self._targets = np.zeros(len(self._staged), np.int64)
        self._count = 0
        # One slot more, always zero: slot -1.
        number = torch.from_numpy(self._staged).dtype
        self._frames = torch.zeros((self._zero + 1, *frame_shape), dtype=number, device=device)

    @property
    def nbytes(self) -> int:
        """Bytes of all slots, written or not, on the device, and of the frames that wait."""
        return self._frames.numel() * self._frames.element_size() + self._staged.nbytes

    def write(self, lane: int, within: int, frame: Frames) -> None:
        """Store a frame."""
        self._staged[self._count] = frame
        self._targets[self._count] = lane * self._slots + within
        self._count += 1
        if self._count == len(self._staged):
            self._send()

    def drop(self, lane: int, within: int) -> None:
        """Nothing to do: a tensor keeps its size."""

    def read(self, slots: Slots) -> Tensor:
        """Frames ``[*slots.shape, *frame_shape]`` on the device."""
        self._send()
        sources = to_device(np.where(slots < 0, self._zero, slots).reshape(-1), self._frames.device)
        return self._frames.index_select(0, sources).view(*slots.shape, *self._frames.shape[1:])

    def _send(self) -> None:
        count, self._count = self._count, 0
        if count:
            device = self._frames.device
            targets, frames = self._targets[:count], self._staged[:count]
            self._frames.index_copy_(0, to_device(targets, device), to_device(frames, device))
