"""Replay memory of one task (buffer D_i of Algorithm 1): every frame is stored once.

Shapes: L lanes (one per environment copy), N slots per lane, B batch, k stacked frames.

A lane is a ring of slots. A slot holds a frame and, if the agent acted on it, what followed: the transition's next
frame is the next slot's. The last frame of an episode has a slot of its own without an action, so the next observation
is right at termination and truncation, and no stack crosses an episode border (frames before the start are zeros).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

SEGMENT_SLOTS = 1024
"""Slots per stored segment (see :meth:`FrameReplay.segments`)."""


@dataclass(frozen=True)
class Batch:
    """Sampled transitions of one task; observations are stacked ``[B, k*c, ...]``, rewards raw."""

    observations: npt.NDArray[Any]
    actions: npt.NDArray[np.int64]
    rewards: npt.NDArray[np.float32]
    next_observations: npt.NDArray[Any]
    terminated: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Segment:
    """Frames of consecutive slots of a lane, for storing. A complete one never changes again."""

    lane: int
    number: int
    complete: bool


class FrameReplay:
    """A ring of the newest transitions of one task.

    Attributes:
        transitions_added: transitions ever added.
    """

    DERIVED = ("stack", "slots", "num_lanes", "_zero_slot")

    def __init__(
        self, capacity_steps: int, num_lanes: int, frame_shape: tuple[int, ...], dtype: npt.DTypeLike, stack: int
    ) -> None:
        """Reserve the ring; the system hands out its memory as frames come in.

        Args:
            capacity_steps: slots over all lanes. An episode's last frame takes one, too.
            num_lanes: environment copies that add to it.
            frame_shape: one frame, ``(c, H, W)`` or ``(features,)``.
            dtype: of a frame.
            stack: frames k per observation.
        """
        self.stack = stack
        self.slots = capacity_steps // num_lanes
        self.num_lanes = num_lanes
        flat = self.slots * num_lanes
        # One slot more, always zero: stands for the frames before an episode's start.
        self._frames = np.zeros((flat + 1, *frame_shape), dtype)
        self._zero_slot = flat
        self._actions = np.full(flat, -1, np.int16)
        self._rewards = np.zeros(flat, np.float32)
        self._terminated = np.zeros(flat, np.bool_)
        self._age = np.zeros(flat, np.uint8)  # steps since the episode's start, at most stack - 1
        self._valid = np.zeros(flat, np.bool_)  # a transition whose frames are all still there
        self._written = np.zeros(num_lanes, np.int64)  # slots ever written, per lane
        self.transitions_added = 0

    def __len__(self) -> int:
        """Transitions that can be sampled."""
        return int(self._valid.sum())

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Shape of one frame."""
        return self._frames.shape[1:]

    @property
    def frame_dtype(self) -> np.dtype[Any]:
        """Type of a frame."""
        return self._frames.dtype

    def begin(self, lane: int, frame: npt.NDArray[Any]) -> None:
        """Start an episode in a lane with its first frame; what came before keeps its last frame."""
        self._write(lane, frame, age=0)

    def add(self, lane: int, action: int, reward: float, terminated: bool, next_frame: npt.NDArray[Any]) -> None:
        """Add the transition from a lane's newest frame. At an episode's end, :meth:`begin` must follow."""
        slot = self._slot(lane, self._written[lane] - 1)
        self._actions[slot] = action
        self._rewards[slot] = reward
        self._terminated[slot] = terminated
        self._write(lane, next_frame, age=min(int(self._age[slot]) + 1, self.stack - 1))
        self._valid[slot] = True
        self.transitions_added += 1

    def _slot(self, lane: int, position: Any) -> Any:
        return lane * self.slots + position % self.slots

    def _write(self, lane: int, frame: npt.NDArray[Any], age: int) -> None:
        position = int(self._written[lane])
        slot = self._slot(lane, position)
        # Overwriting a frame spoils every later transition whose stack reaches back to it.
        for distance in range(1, self.stack):
            later = self._slot(lane, position + distance)
            if self._age[later] >= distance:
                self._valid[later] = False
        self._valid[slot] = False
        self._actions[slot] = -1
        self._rewards[slot] = 0.0
        self._terminated[slot] = False
        self._frames[slot] = frame
        self._age[slot] = age
        self._written[lane] = position + 1

    def sample(self, batch_size: int, rng: np.random.Generator) -> Batch:
        """Draw transitions uniformly, with replacement.

        Raises:
            ValueError: nothing can be sampled yet.
        """
        if not self._valid.any():
            raise ValueError("the replay holds no transition; add some before sampling")
        filled = min(int(self._written.max()), self.slots)
        chosen = np.empty(0, np.int64)
        while len(chosen) < batch_size:  # rejection: uniform over the valid slots
            draw = rng.integers(0, self.num_lanes * filled, size=batch_size - len(chosen))
            slots = draw // filled * self.slots + draw % filled
            chosen = np.concatenate([chosen, slots[self._valid[slots]]])
        return self.gather(chosen)

    def gather(self, slots: npt.NDArray[np.int64]) -> Batch:
        """The transitions that start in these (flat) slots."""
        k = self.stack
        lanes_B1, within_B1 = slots[:, None] // self.slots, slots[:, None] % self.slots
        back = np.arange(k - 1, -2, -1)[None, :]  # k-1 ... 0 for the observation, -1 for the next frame
        sources = lanes_B1 * self.slots + (within_B1 - back) % self.slots
        before_start = back > self._age[slots][:, None]
        frames = self._frames[np.where(before_start, self._zero_slot, sources)]  # [B, k+1, c, ...]
        shape = (len(slots), k * frames.shape[2], *frames.shape[3:])
        return Batch(
            observations=frames[:, :k].reshape(shape),
            actions=self._actions[slots].astype(np.int64),
            rewards=self._rewards[slots],
            next_observations=frames[:, 1:].reshape(shape),
            terminated=self._terminated[slots],
        )

    def valid_slots(self) -> npt.NDArray[np.int64]:
        """All slots that can be sampled, for tests and for going through the memory in order."""
        return np.flatnonzero(self._valid)

    # Storing: small arrays as state, frames as segments.

    def state_dict(self) -> dict[str, Any]:
        """Everything but the frames."""
        return {
            "written": self._written.copy(),
            "transitions_added": self.transitions_added,
            **{name: np.concatenate(list(self._by_lane(array))) for name, array in self._arrays().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put everything but the frames back; :meth:`load_segment` brings the frames."""
        self._written[:] = state["written"]
        self.transitions_added = int(state["transitions_added"])
        for name, array in self._arrays().items():
            offset = 0
            for part in self._by_lane(array):
                part[:] = state[name][offset : offset + len(part)]
                offset += len(part)

    def _arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {
            "actions": self._actions,
            "rewards": self._rewards,
            "terminated": self._terminated,
            "age": self._age,
            "valid": self._valid,
        }

    def _by_lane(self, array: npt.NDArray[Any]) -> Iterator[npt.NDArray[Any]]:
        """The written part of each lane (a view)."""
        for lane in range(self.num_lanes):
            start = lane * self.slots
            yield array[start : start + min(int(self._written[lane]), self.slots)]

    def segments(self) -> Iterator[Segment]:
        """The segments that cover the frames held now, oldest first in each lane."""
        for lane in range(self.num_lanes):
            written = int(self._written[lane])
            first = max(0, written - self.slots) // SEGMENT_SLOTS
            for number in range(first, -(-written // SEGMENT_SLOTS)):
                yield Segment(lane, number, (number + 1) * SEGMENT_SLOTS <= written)

    def read_segment(self, segment: Segment) -> npt.NDArray[Any]:
        """Frames of a segment as far as they are written ``[<= SEGMENT_SLOTS, c, ...]``."""
        written = int(self._written[segment.lane])
        start = segment.number * SEGMENT_SLOTS
        positions = np.arange(start, min(start + SEGMENT_SLOTS, written))
        frames: npt.NDArray[Any] = self._frames[self._slot(segment.lane, positions)]
        return frames

    def load_segment(self, segment: Segment, frames: npt.NDArray[Any]) -> None:
        """Put the frames of a segment back that are not overwritten by newer ones."""
        written = int(self._written[segment.lane])
        positions = segment.number * SEGMENT_SLOTS + np.arange(len(frames))
        current = (positions >= written - self.slots) & (positions < written)
        self._frames[self._slot(segment.lane, positions[current])] = frames[current]

    def check_valid(self) -> None:
        """Assert the invariants (tests call it after random operations)."""
        for slot in self.valid_slots():
            lane, within = divmod(int(slot), self.slots)
            newest = (int(self._written[lane]) - 1) % self.slots
            behind_newest = (newest - within) % self.slots
            held = min(int(self._written[lane]), self.slots)
            assert self._actions[slot] >= 0, "a valid slot has an action"
            assert behind_newest >= 1, "a valid slot has a next frame"
            assert behind_newest + int(self._age[slot]) < held, "a valid slot's stack is held"
