"""Where a replay memory's frames lie: a plain ring of arrays, or blocks that are compressed without loss.

Both are addressed by flat slots (lane times slots per lane plus slot within the lane; -1 is a frame of zeros), both are
written slot after slot within a lane, and both give back the same bytes.
"""

from __future__ import annotations

import functools
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
import zstandard

from switchmt_snn.replay.slabs import Place, Slabs

ZSTD_LEVEL = 3
_FEW_BLOCKS = 8
"""Read by one thread: another would take longer to wake."""

Slots = npt.NDArray[np.int64]
Frames = npt.NDArray[Any]


class FrameStore(Protocol):
    """Frames of a ring with ``num_lanes`` lanes."""

    @property
    def nbytes(self) -> int:
        """Bytes that the frames take now, with everything that is needed to find them."""

    def write(self, lane: int, within: int, frame: Frames) -> None:
        """Store a lane's next frame; the first slot of a block drops the block that was there."""

    def drop(self, lane: int, within: int) -> None:
        """Forget the block that holds a slot."""

    def read(self, slots: Slots) -> Any:
        """Frames ``[*slots.shape, *frame_shape]``, an array or a tensor; what was never written or dropped is
        undefined."""


class PlainFrames:
    """One array for everything; its pages are handed out as they are written."""

    def __init__(self, num_lanes: int, slots: int, frame_shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._slots = slots
        # One slot more, always zero: the last one, which is slot -1.
        self._frames = np.zeros((num_lanes * slots + 1, *frame_shape), dtype)

    @property
    def nbytes(self) -> int:
        """Bytes of all slots, written or not."""
        return self._frames.nbytes

    def write(self, lane: int, within: int, frame: Frames) -> None:
        """Store a frame."""
        self._frames[lane * self._slots + within] = frame

    def drop(self, lane: int, within: int) -> None:
        """Nothing to do: an array keeps its size."""

    def read(self, slots: Slots) -> Frames:
        """Frames ``[*slots.shape, *frame_shape]``."""
        frames: Frames = self._frames[slots]
        return frames


class CompressedFrames:
    """Blocks of ``block_slots`` consecutive frames: each frame XOR the one before it, then Zstandard.

    The newest block of a lane is plain until it is full. What does not compress takes the size of the frames.
    """

    def __init__(
        self, num_lanes: int, slots: int, frame_shape: tuple[int, ...], dtype: npt.DTypeLike, block_slots: int
    ) -> None:
        self._slots, self._shape, self._dtype = slots, frame_shape, np.dtype(dtype)
        self._block_slots = block_slots
        self._frame_bytes = int(np.prod(frame_shape)) * self._dtype.itemsize
        self._blocks_per_lane = -(-slots // self._block_slots)
        self._contents = Slabs()
        # Of each block: its ``Place`` (slab -1: not held).
        self._places = np.full((num_lanes * self._blocks_per_lane, 3), -1, np.int64)
        # Of each lane: the block that is being filled (-1: none) and its frames.
        self._open = np.full(num_lanes, -1, np.int64)
        self._open_frames = np.zeros((num_lanes, self._block_slots, self._frame_bytes), np.uint8)
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self._of_thread = threading.local()  # a decompressor works on one block at a time

    @property
    def nbytes(self) -> int:
        """Bytes of the compressed blocks, of their places, and of the open blocks."""
        return self._contents.content_bytes + self._places.nbytes + self._open_frames.nbytes

    def write(self, lane: int, within: int, frame: Frames) -> None:
        """Store a lane's next frame; compresses its block if that is full."""
        block, offset = self._block(lane, within), within % self._block_slots
        if offset == 0:
            self._store(block, None)
            self._open[lane] = block
        self._open_frames[lane, offset] = np.ascontiguousarray(frame, self._dtype).reshape(-1).view(np.uint8)
        if offset == self._block_slots - 1 or within == self._slots - 1:
            frames = self._open_frames[lane, : offset + 1]
            changes = frames.copy()
            np.bitwise_xor(frames[1:], frames[:-1], out=changes[1:])
            self._store(block, self._compressor.compress(changes.data))
            self._open[lane] = -1

    def drop(self, lane: int, within: int) -> None:
        """Forget the block that holds a slot."""
        self._store(self._block(lane, within), None)

    def read(self, slots: Slots) -> Frames:
        """Frames ``[*slots.shape, *frame_shape]``; every block is decompressed once. A second thread takes half of them
        if PyTorch has more than one; more threads were not measured."""
        flat = slots.reshape(-1)
        out = np.empty((len(flat), self._frame_bytes), np.uint8)
        lanes, within = flat // self._slots, flat % self._slots
        blocks = np.where(flat < 0, -1, lanes * self._blocks_per_lane + within // self._block_slots)
        order = np.argsort(blocks, kind="stable")
        blocks, offsets = blocks[order], (within % self._block_slots)[order]
        starts = np.flatnonzero(np.diff(blocks, prepend=-2))
        goes_on = (np.diff(order, prepend=-2) == 1) & (np.diff(offsets, prepend=-2) == 1)
        goes_on[starts] = True
        columns = (
            blocks[starts],
            starts,
            np.append(starts, len(flat))[1:],
            np.minimum.reduceat(offsets, starts),
            np.maximum.reduceat(offsets, starts),
            np.logical_and.reduceat(goes_on, starts),  # consecutive frames, for consecutive places of `out`
        )
        parts = list(zip(*(column.tolist() for column in columns), strict=True))

        def read_blocks(parts: list[tuple[int, ...]]) -> None:
            for block, start, end, first, last, is_run in parts:
                places = order[start:end]
                if block < 0:
                    out[places] = 0
                elif is_run:
                    self._read_block(block, first, out[places[0] : places[0] + end - start])
                else:
                    frames = np.empty((last - first + 1, self._frame_bytes), np.uint8)
                    self._read_block(block, first, frames)
                    out[places] = frames[offsets[start:end] - first]

        if len(parts) <= _FEW_BLOCKS or torch.get_num_threads() == 1:
            read_blocks(parts)
        else:
            other_half = _second_thread().submit(read_blocks, parts[1::2])
            read_blocks(parts[::2])
            other_half.result()
        return out.view(self._dtype).reshape(*slots.shape, *self._shape)

    def _block(self, lane: int, within: int) -> int:
        return lane * self._blocks_per_lane + within // self._block_slots

    def _store(self, block: int, content: bytes | None) -> None:
        stored = Place(*self._places[block].tolist())
        if stored.slab >= 0:
            self._contents.remove(stored)
        self._places[block] = (-1, -1, -1) if content is None else self._contents.add(content)

    def _read_block(self, block: int, first: int, out: npt.NDArray[np.uint8]) -> None:
        """Frames of a block as bytes, from one of them on; zeros if the block is not held."""
        lane, place = block // self._blocks_per_lane, Place(*self._places[block].tolist())
        if self._open[lane] == block:
            out[:] = self._open_frames[lane, first : first + len(out)]
            return
        if place.slab < 0:
            out[:] = 0
            return
        if not hasattr(self._of_thread, "decompressor"):
            self._of_thread.decompressor = zstandard.ZstdDecompressor()
        content = self._of_thread.decompressor.decompress(self._contents.view(place))
        changes = np.frombuffer(content, np.uint8)
        changes = changes.reshape(-1, self._frame_bytes)
        np.bitwise_xor.reduce(changes[: first + 1], axis=0, out=out[0])
        for index in range(1, len(out)):
            np.bitwise_xor(out[index - 1], changes[first + index], out=out[index])


@functools.cache
def _second_thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="frames")
