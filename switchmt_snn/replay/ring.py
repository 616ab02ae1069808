"""Replay memory of one task (buffer D_i of Algorithm 1): every frame is stored once.

Shapes: L lanes (one per environment copy), N slots per lane, B batch, k stacked frames.

A lane is a ring of slots. A slot holds a frame and, if the agent acted on it, what followed: the transition's next
frame is the next slot's. The last frame of an episode has a slot of its own without an action, so the next observation
is right at termination and truncation, and no stack crosses an episode border (frames before the start are zeros).

Old frames leave in blocks of a few slots: when the first slot of a block is overwritten, and the oldest while frames
take more bytes than they may. Frames lie plain or compressed (``switchmt_snn.replay.frames``), or on
the learner's device (``switchmt_snn.replay.on_device``); else all is alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from switchmt_snn.errors import CheckpointError, require_saved
from switchmt_snn.replay.frames import CompressedFrames, FrameStore, PlainFrames
from switchmt_snn.replay.on_device import DeviceFrames

BLOCK_SLOTS = 16
"""Frames that leave, and are compressed, together. Fewer take more bytes; of more, one frame takes longer to read."""
SEGMENT_SLOTS = 1024
"""Slots per stored segment (see ``FrameReplay.segments``)."""


@dataclass(frozen=True)
class Returns:
    """How the rewards that follow an action become one number: ``sum_i discount^i r_(t+i)`` over up to n steps.

    The sum stops early after a terminal step, at the end of a truncated episode, and at the newest step of the lane.
    Its target then bootstraps (unless terminal) from the observation at which it stopped.

    Attributes:
        n_steps: longest sum (1: the plain transition).
        discount: gamma.
        clip_rewards: clip every reward to [-1, 1] before it is added.
    """

    n_steps: int = 1
    discount: float = 0.99
    clip_rewards: bool = False


@dataclass(frozen=True)
class Batch:
    """Sampled transitions of one task, of up to n steps each.

    Observations are stacked ``[B, k*c, ...]`` (tensors if frames are stored on the learner's device).

    Attributes:
        rewards: discounted sum of the rewards of the transition's steps; raw unless ``Returns`` clips them.
        next_observations: the observation after these steps.
        terminated: whether the last of them was terminal.
        discounts: what the value of the next observation is multiplied by: ``discount^steps``.
    """

    observations: npt.NDArray[Any] | Tensor
    actions: npt.NDArray[np.int64]
    rewards: npt.NDArray[np.float32]
    next_observations: npt.NDArray[Any] | Tensor
    terminated: npt.NDArray[np.bool_]
    discounts: npt.NDArray[np.float32]


@dataclass(frozen=True)
class Segment:
    """Frames of consecutive slots of a lane, for storing. A complete one never changes again."""

    lane: int
    number: int
    complete: bool


_MOST_STEPS = 2**53
"""Of a lane: more than any run makes."""


class FrameReplay:
    """A ring of the newest transitions of one task.

    Attributes:
        transitions_added: transitions ever added.

    Examples:
        >>> replay = FrameReplay(capacity_steps=100, num_lanes=1, frame_shape=(2,), dtype=np.float32, stack=1)
        >>> replay.begin(0, np.array([0.0, 0.0], np.float32))
        >>> replay.add(0, action=1, reward=0.5, terminated=False, next_frame=np.array([1.0, 2.0], np.float32))
        >>> batch = replay.sample(batch_size=1, rng=np.random.default_rng(0), returns=Returns())
        >>> batch.next_observations.tolist(), batch.rewards.tolist()
        ([[1.0, 2.0]], [0.5])
    """

    DERIVED = ("stack", "slots", "num_lanes", "block_slots", "max_bytes", "_frames", "frame_shape", "frame_dtype")

    def __init__(
        self,
        capacity_steps: int,
        num_lanes: int,
        frame_shape: tuple[int, ...],
        dtype: npt.DTypeLike,
        stack: int,
        compressed: bool = False,
        max_bytes: int | None = None,
        device: torch.device | None = None,
    ) -> None:
        """Reserve the ring; the system hands out an array's memory as frames come in, a tensor's at once.

        Args:
            capacity_steps: slots over all lanes. An episode's last frame takes one, too.
            num_lanes: environment copies that add to it.
            frame_shape: one frame, ``(c, H, W)`` or ``(features,)``.
            dtype: of a frame.
            stack: frames k per observation.
            compressed: keep frames compressed, without loss.
            max_bytes: the oldest blocks leave while compressed frames take more.
            device: keep frames in a tensor there, and sample observations as tensors there; not compressed.
        """
        self.stack = stack
        self.slots = capacity_steps // num_lanes
        self.num_lanes = num_lanes
        self.frame_shape, self.frame_dtype = frame_shape, np.dtype(dtype)
        # A ring of few slots cannot do without many of them at once.
        self.block_slots = BLOCK_SLOTS if self.slots >= 8 * BLOCK_SLOTS else 1
        self.max_bytes = max_bytes if compressed else None
        form = (num_lanes, self.slots, frame_shape, dtype)
        self._frames: FrameStore
        if compressed:
            self._frames = CompressedFrames(*form, self.block_slots)
        else:
            self._frames = PlainFrames(*form) if device is None else DeviceFrames(*form, device)
        flat = self.slots * num_lanes
        self._actions = np.full(flat, -1, np.int32)
        self._rewards = np.zeros(flat, np.float32)
        self._terminated = np.zeros(flat, np.bool_)
        self._age = np.zeros(flat, np.uint8)  # steps since the episode's start, at most stack - 1
        self._valid = np.zeros(flat, np.bool_)  # a transition whose frames are all still there
        self._written = np.zeros(num_lanes, np.int64)  # slots ever written, per lane
        self._oldest = np.zeros(num_lanes, np.int64)  # position of the oldest frame held, per lane
        self.transitions_added = 0

    def __len__(self) -> int:
        """Transitions that can be sampled."""
        return int(self._valid.sum())

    @property
    def nbytes(self) -> int:
        """Bytes of everything that is held: frames, actions, rewards, flags."""
        return self._frames.nbytes + sum(array.nbytes for array in self._arrays().values())

    def begin(self, lane: int, frame: npt.NDArray[Any]) -> None:
        """Start an episode in a lane with its first frame; what came before keeps its last frame."""
        self._write(lane, frame, age=0)

    def add(self, lane: int, action: int, reward: float, terminated: bool, next_frame: npt.NDArray[Any]) -> None:
        """Add the transition from a lane's newest frame. At an episode's end, ``begin`` must follow.

        ``terminated`` is for targets: where an episode goes on after it (a life was lost), stacks go on, too.
        """
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
        if position >= self.slots and position % self.slots % self.block_slots == 0:
            self._drop_before(lane, position - self.slots + self._block_length(position))
        self._valid[slot] = False
        self._actions[slot] = -1
        self._rewards[slot] = 0.0
        self._terminated[slot] = False
        self._frames.write(lane, position % self.slots, frame)
        self._age[slot] = age
        self._written[lane] = position + 1
        while self.max_bytes is not None and self._frames.nbytes > self.max_bytes:
            held = self._written - self._oldest
            fullest = int(held.argmax())
            if held[fullest] <= 2 * self.block_slots + self.stack:
                break  # less than that is no memory; the open blocks alone take as much
            oldest = int(self._oldest[fullest])
            self._frames.drop(fullest, oldest % self.slots)
            self._drop_before(fullest, oldest + self._block_length(oldest))

    def _block_length(self, position: int) -> int:
        """Slots of the block at whose start a position is; the last block of a lane may be shorter."""
        return min(self.block_slots, self.slots - position % self.slots)

    def _drop_before(self, lane: int, oldest: int) -> None:
        """Make ``oldest`` the oldest position held; spoils every transition that needs an older frame."""
        gone = np.arange(int(self._oldest[lane]), oldest)
        self._valid[self._slot(lane, gone)] = False
        for distance in range(self.stack - 1):
            later = self._slot(lane, oldest + distance)
            if self._age[later] > distance:
                self._valid[later] = False
        self._oldest[lane] = max(int(self._oldest[lane]), oldest)

    def sample(self, batch_size: int, rng: np.random.Generator, returns: Returns) -> Batch:
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
        return self.gather(chosen, returns)

    def gather(self, slots: npt.NDArray[np.int64], returns: Returns) -> Batch:
        """The transitions that start in these (flat) slots."""
        k, n = self.stack, returns.n_steps
        rewards_B, terminated_B, steps_B = self._add_up(slots, returns)
        lanes_B1, within_B1 = slots[:, None] // self.slots, slots[:, None] % self.slots
        offsets = np.arange(1 - k, n + 1)[None, :]  # 1-k ... 0 for the observation, then the frames that follow
        sources = lanes_B1 * self.slots + (within_B1 + offsets) % self.slots
        outside = (-offsets > self._age[slots][:, None]) | (offsets > steps_B[:, None])
        frames = self._frames.read(np.where(outside, -1, sources))  # [B, k+n, c, ...]
        if n == 1:
            next_frames = frames[:, 1:]
        else:
            last_k_Bk = steps_B[:, None] + np.arange(k)[None, :]
            next_frames = frames[np.arange(len(slots))[:, None], last_k_Bk]
        shape = (len(slots), k * frames.shape[2], *frames.shape[3:])
        return Batch(
            observations=frames[:, :k].reshape(shape),
            actions=self._actions[slots].astype(np.int64),
            rewards=rewards_B,
            next_observations=next_frames.reshape(shape),
            terminated=terminated_B,
            discounts=(returns.discount**steps_B).astype(np.float32),
        )

    def _add_up(
        self, slots: npt.NDArray[np.int64], returns: Returns
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
        """For each start slot ``[B]``: discounted sum of rewards, whether its last step was terminal, its length."""
        total_B = np.zeros(len(slots), np.float32)
        terminated_B = np.zeros(len(slots), np.bool_)
        steps_B = np.zeros(len(slots), np.int64)
        lanes_B, within_B = slots // self.slots, slots % self.slots
        running_B = np.ones(len(slots), np.bool_)
        for step in range(returns.n_steps):
            now_B = lanes_B * self.slots + (within_B + step) % self.slots
            running_B &= self._actions[now_B] >= 0  # the last frame of an episode, and the newest one, have no action
            reward_B = self._rewards[now_B]
            if returns.clip_rewards:
                reward_B = reward_B.clip(-1.0, 1.0)
            total_B += np.where(running_B, np.float32(returns.discount**step) * reward_B, np.float32(0.0))
            steps_B += running_B
            terminated_B |= running_B & self._terminated[now_B]
            running_B &= ~self._terminated[now_B]
        return total_B, terminated_B, steps_B

    def valid_slots(self) -> npt.NDArray[np.int64]:
        """All slots that can be sampled, for tests and for going through the memory in order."""
        return np.flatnonzero(self._valid)

    # Storing: small arrays as state, frames as segments.

    def state_dict(self) -> dict[str, Any]:
        """Everything but the frames."""
        return {
            "written": self._written.copy(),
            "oldest": self._oldest.copy(),
            "transitions_added": self.transitions_added,
            **{name: np.concatenate(list(self._by_lane(array))) for name, array in self._arrays().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put everything but the frames back; ``load_segment`` brings the frames.

        Raises:
            CheckpointError: the state is not whole, or of another size; nothing is changed.
        """
        self.require_fits(state)
        self._written[:] = state["written"]
        self._oldest[:] = state["oldest"]
        self.transitions_added = int(state["transitions_added"])
        for name, array in self._arrays().items():
            offset = 0
            for part in self._by_lane(array):
                part[:] = state[name][offset : offset + len(part)]
                offset += len(part)

    def require_fits(self, state: dict[str, Any]) -> None:
        """Refuse a state that is not whole, of another size, or of which samples could not be drawn.

        Raises:
            CheckpointError: naming the array.
        """
        owner, arrays = type(self).__name__, self._arrays()
        require_saved(state, ("written", "oldest", "transitions_added", *arrays), owner)
        lanes = np.shape(self._written)
        whole = np.shape(state["written"]) == lanes and np.asarray(state["written"]).dtype.kind == "i"
        held = int(np.minimum(np.asarray(state["written"], np.int64), self.slots).sum()) if whole else -1
        expected = {"written": lanes, "oldest": lanes, **dict.fromkeys(arrays, (held,))}
        dtypes = {"written": self._written.dtype, "oldest": self._oldest.dtype}
        dtypes |= {name: array.dtype for name, array in arrays.items()}  # older versions had shorter ones
        for name, shape in expected.items():
            if np.shape(state[name]) != shape or np.asarray(state[name]).dtype.kind != dtypes[name].kind:
                raise CheckpointError(
                    f"the checkpoint has {name} of shape {np.shape(state[name])} and type "
                    f"{np.asarray(state[name]).dtype!s:.20} of {owner}, expected {shape} and {dtypes[name]}; set "
                    "tasks.num_envs and learning.replay_capacity_steps as they were, or start a new run with --run"
                )
        if unsound := self._unsound(state):
            raise CheckpointError(
                f"the checkpoint has {unsound} of {owner}, expected what a run saves; start a new run"
            )

    def _unsound(self, state: dict[str, Any]) -> str:
        """What of a state of the right shapes breaks the invariants of ``check_valid``; empty if nothing does."""
        written, oldest = (np.asarray(state[name], np.int64) for name in ("written", "oldest"))
        added = state["transitions_added"]
        if not isinstance(added, int) or not 0 <= added < _MOST_STEPS:
            return "transitions_added out of range"
        if (oldest < 0).any() or (oldest > written).any() or (written - oldest > self.slots).any():
            return "positions of frames out of range"
        if (written >= _MOST_STEPS).any() or not np.isfinite(state["rewards"]).all():
            return "positions or rewards that are no numbers of a run"
        if (state["age"] >= self.stack).any() or (state["actions"] < -1).any():
            return "ages or actions out of range"
        offset = 0
        for lane_written, lane_oldest in zip(written.tolist(), oldest.tolist(), strict=True):
            length = min(lane_written, self.slots)
            part = slice(offset, offset + length)
            valid = np.flatnonzero(state["valid"][part])
            behind_newest = (lane_written - 1 - valid) % self.slots
            reach = behind_newest + state["age"][part][valid]
            if (behind_newest < 1).any() or (reach >= lane_written - lane_oldest).any():
                return "transitions whose frames are gone"
            if (state["actions"][part][valid] < 0).any():
                return "transitions without an action"
            offset += length
        return ""

    def actions_held(self) -> npt.NDArray[np.int32]:
        """Actions of the transitions that can be sampled."""
        return self._actions[self._valid]

    def segments_of(self, state: dict[str, Any]) -> dict[tuple[int, int], int]:
        """Frames of each segment that belongs to a state, by lane and number.

        Args:
            state: one that fits.
        """
        found = {}
        for lane, (written, oldest) in enumerate(zip(state["written"].tolist(), state["oldest"].tolist(), strict=True)):
            for number in range(oldest // SEGMENT_SLOTS, -(-written // SEGMENT_SLOTS)):
                found[lane, number] = min(SEGMENT_SLOTS, written - number * SEGMENT_SLOTS)
        return found

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
            first = int(self._oldest[lane]) // SEGMENT_SLOTS
            for number in range(first, -(-written // SEGMENT_SLOTS)):
                yield Segment(lane, number, (number + 1) * SEGMENT_SLOTS <= written)

    def read_segment(self, segment: Segment) -> npt.NDArray[Any]:
        """Frames of a segment as far as they are written ``[<= SEGMENT_SLOTS, c, ...]``; zeros where one has left."""
        written, oldest = int(self._written[segment.lane]), int(self._oldest[segment.lane])
        start = segment.number * SEGMENT_SLOTS
        positions = np.arange(start, min(start + SEGMENT_SLOTS, written))
        frames = self._frames.read(np.where(positions < oldest, -1, self._slot(segment.lane, positions)))
        return frames.cpu().numpy() if isinstance(frames, Tensor) else frames

    def load_segment(self, segment: Segment, frames: npt.NDArray[Any]) -> None:
        """Put the frames of a segment back that are still held; a lane's segments must come in order."""
        written, oldest = int(self._written[segment.lane]), int(self._oldest[segment.lane])
        positions = segment.number * SEGMENT_SLOTS + np.arange(len(frames))
        for position, frame in zip(positions.tolist(), frames, strict=True):
            if oldest <= position < written:
                self._frames.write(segment.lane, position % self.slots, frame)

    def check_valid(self) -> None:
        """Assert the invariants (tests call it after random operations)."""
        for slot in self.valid_slots():
            lane, within = divmod(int(slot), self.slots)
            newest = (int(self._written[lane]) - 1) % self.slots
            behind_newest = (newest - within) % self.slots
            held = int(self._written[lane] - self._oldest[lane])
            assert self._actions[slot] >= 0, "a valid slot has an action"
            assert behind_newest >= 1, "a valid slot has a next frame"
            assert behind_newest + int(self._age[slot]) < held, "a valid slot's stack is held"
