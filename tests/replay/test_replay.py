"""The replay memory against a naive list of whole transitions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from switchmt_snn.replay.frames import CompressedFrames, PlainFrames
from switchmt_snn.replay.ring import BLOCK_SLOTS, SEGMENT_SLOTS, FrameReplay, Returns, Segment


@dataclass
class NaiveLane:
    """Keeps every transition whole, and how many slots were written when its oldest frame was."""

    slots: int
    stack: int
    shape: tuple[int, ...]
    episode: list[npt.NDArray[np.uint8]] = field(default_factory=list)
    transitions: list[dict] = field(default_factory=list)
    starts: list[int] = field(default_factory=list)
    written: int = 0

    def begin(self, frame: npt.NDArray[np.uint8]) -> None:
        self.starts.append(len(self.transitions))
        self.episode = [frame]
        self.written += 1

    def stacked(self, frames: list[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
        padding = [np.zeros(self.shape, np.uint8)] * self.stack
        return np.concatenate((padding + frames)[-self.stack :])

    def add(self, action: int, reward: float, terminated: bool, frame: npt.NDArray[np.uint8]) -> None:
        observation = self.stacked(self.episode)
        reach = min(len(self.episode), self.stack)
        oldest = self.written - reach
        self.episode = [*self.episode, frame]
        self.written += 1
        self.transitions.append(
            {
                "observation": observation,
                "action": action,
                "reward": reward,
                "terminated": terminated,
                "next": self.stacked(self.episode),
                "oldest": oldest,
                "episode": len(self.starts),
            }
        )

    def held(self) -> list[dict]:
        """Frames leave in whole blocks, when the first slot of theirs is overwritten."""
        block = BLOCK_SLOTS if self.slots >= 8 * BLOCK_SLOTS else 1
        newest = self.written - 1
        start = newest - newest % self.slots % block
        oldest = max(0, start - self.slots + min(block, self.slots - start % self.slots))
        return [t for t in self.transitions if t["oldest"] >= oldest]

    def following(self, first: dict, n_steps: int) -> list[dict]:
        """The transition and those after it in its episode, up to a terminal one."""
        at = next(i for i, one in enumerate(self.transitions) if one is first)
        chain: list[dict] = []
        for one in self.transitions[at : at + n_steps]:
            if one["episode"] != first["episode"]:
                break
            chain.append(one)
            if one["terminated"]:
                break
        return chain


ONE_STEP = Returns()
FORMS = ("plain", "compressed", "device")


def ring(
    form: str, capacity: int, lanes: int, shape: tuple[int, ...], stack: int, dtype: type = np.uint8
) -> FrameReplay:
    """A replay whose frames lie as ``form`` says; the device is the CPU here."""
    device = torch.device("cpu") if form == "device" else None
    return FrameReplay(capacity, lanes, shape, dtype, stack, form == "compressed", device=device)


def drive(replay: FrameReplay, lanes: list[NaiveLane], rng: np.random.Generator, operations: int) -> None:
    """Random pushes, terminations, truncations, cuts, and terminal steps after which the episode goes on, into both."""
    shape = lanes[0].shape
    for lane_id, lane in enumerate(lanes):
        frame = rng.integers(0, 256, shape, np.uint8)
        lane.begin(frame)
        replay.begin(lane_id, frame)
    for _ in range(operations):
        lane_id = int(rng.integers(len(lanes)))
        event = rng.random()
        frame = rng.integers(0, 256, shape, np.uint8)
        action, reward, terminated = int(rng.integers(18)), float(rng.normal()), bool(event < 0.1 or event > 0.9)
        lanes[lane_id].add(action, reward, terminated, frame)
        replay.add(lane_id, action, reward, terminated, frame)
        if event < 0.2:  # terminated or truncated, or the task was left; above 0.9 only a life was lost
            first = rng.integers(0, 256, shape, np.uint8)
            lanes[lane_id].begin(first)
            replay.begin(lane_id, first)


def compare(replay: FrameReplay, lanes: list[NaiveLane]) -> None:
    replay.check_valid()
    batch = replay.gather(replay.valid_slots(), ONE_STEP)
    observations, following = np.asarray(batch.observations), np.asarray(batch.next_observations)
    ours = {
        (o.tobytes(), int(a), float(r), bool(t), n.tobytes())
        for o, a, r, t, n in zip(observations, batch.actions, batch.rewards, batch.terminated, following, strict=True)
    }
    naive = {
        (t["observation"].tobytes(), t["action"], float(np.float32(t["reward"])), t["terminated"], t["next"].tobytes())
        for lane in lanes
        for t in lane.held()
    }
    assert ours == naive
    assert len(replay) == sum(len(lane.held()) for lane in lanes)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    num_lanes=st.integers(1, 3),
    slots=st.integers(6, 40) | st.integers(8 * BLOCK_SLOTS, 300),
    stack=st.integers(1, 5),
    operations=st.integers(0, 1000),
    seed=st.integers(0, 2**31),
    form=st.sampled_from(FORMS),
)
@example(num_lanes=2, slots=24, stack=4, operations=500, seed=0, form="plain")
@example(num_lanes=2, slots=24, stack=4, operations=500, seed=0, form="device")
@example(num_lanes=2, slots=8 * BLOCK_SLOTS, stack=4, operations=500, seed=0, form="compressed")
def test_equals_naive_list(num_lanes: int, slots: int, stack: int, operations: int, seed: int, form: str) -> None:
    shape = (2, 3)
    replay = ring(form, slots * num_lanes, num_lanes, shape, stack)
    lanes = [NaiveLane(slots, stack, shape) for _ in range(num_lanes)]
    drive(replay, lanes, np.random.default_rng(seed), operations)
    compare(replay, lanes)
    assert len(replay) > 0 or operations < 200


def test_two_steps_by_hand() -> None:
    """Rewards 1, 10, 100 and a terminal end: sums of two steps with discount 0.5 are 1 + 5, 10 + 50, 100."""
    replay = FrameReplay(20, 1, (1,), np.float32, 1)
    frames = [np.full(1, value, np.float32) for value in range(4)]
    replay.begin(0, frames[0])
    for step, reward in enumerate((1.0, 10.0, 100.0)):
        replay.add(0, step, reward, step == 2, frames[step + 1])
    batch = replay.gather(replay.valid_slots(), Returns(n_steps=2, discount=0.5))
    assert batch.rewards.tolist() == [6.0, 60.0, 100.0]
    assert batch.terminated.tolist() == [False, True, True]
    assert np.ravel(batch.next_observations).tolist() == [2.0, 3.0, 3.0]
    assert batch.discounts.tolist() == [0.25, 0.25, 0.5]
    clipped = replay.gather(replay.valid_slots(), Returns(n_steps=2, discount=0.5, clip_rewards=True))
    assert clipped.rewards.tolist() == [1.5, 1.5, 1.0]


def test_a_truncated_episode_and_the_newest_step_end_a_sum_and_still_bootstrap() -> None:
    replay = FrameReplay(20, 1, (1,), np.float32, 1)
    for episode in range(2):
        replay.begin(0, np.full(1, 10.0 * episode, np.float32))
        for step in range(2):
            replay.add(0, step, 1.0, False, np.full(1, 10.0 * episode + step + 1, np.float32))
    batch = replay.gather(replay.valid_slots(), Returns(n_steps=3, discount=0.5))
    assert batch.rewards.tolist() == [1.5, 1.0, 1.5, 1.0]
    assert np.ravel(batch.next_observations).tolist() == [2.0, 2.0, 12.0, 12.0]
    assert batch.discounts.tolist() == [0.25, 0.5, 0.25, 0.5]
    assert not batch.terminated.any()


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    num_lanes=st.integers(1, 3),
    slots=st.integers(6, 40) | st.integers(8 * BLOCK_SLOTS, 300),
    stack=st.integers(1, 4),
    operations=st.integers(0, 700),
    n_steps=st.integers(1, 6),
    clip=st.booleans(),
    seed=st.integers(0, 2**31),
    form=st.sampled_from(FORMS),
)
def test_sums_of_n_steps_equal_the_naive_list(
    num_lanes: int, slots: int, stack: int, operations: int, n_steps: int, clip: bool, seed: int, form: str
) -> None:
    """They stop at terminal steps, truncated episodes, lane borders and the newest step, also in a wrapped ring."""
    shape, discount = (2, 3), 0.9
    replay = ring(form, slots * num_lanes, num_lanes, shape, stack)
    lanes = [NaiveLane(slots, stack, shape) for _ in range(num_lanes)]
    drive(replay, lanes, np.random.default_rng(seed), operations)
    batch = replay.gather(replay.valid_slots(), Returns(n_steps, discount, clip))
    ours = {
        (np.asarray(o).tobytes(), int(a)): (float(r), bool(t), np.asarray(n).tobytes(), float(d))
        for o, a, r, n, t, d in zip(*vars(batch).values(), strict=True)
    }
    expected = {}
    for lane in lanes:
        for first in lane.held():
            chain = lane.following(first, n_steps)
            rewards = [np.clip(one["reward"], -1, 1) if clip else one["reward"] for one in chain]
            total = sum(discount**i * reward for i, reward in enumerate(rewards))
            last = chain[-1]
            outcome = (total, last["terminated"], last["next"].tobytes(), discount ** len(chain))
            expected[first["observation"].tobytes(), first["action"]] = outcome
    assert ours.keys() == expected.keys()
    for key, (total, *rest, factor) in expected.items():
        assert ours[key][0] == pytest.approx(total, rel=1e-5, abs=1e-6)
        assert list(ours[key][1:3]) == rest
        assert ours[key][3] == pytest.approx(factor)


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("slots", [700, SEGMENT_SLOTS, 2500])
def test_stored_and_loaded_is_the_same(slots: int, form: str) -> None:
    """Segments of an older moment plus those written since give the ring back, also after it went round."""
    shape = (1, 2)
    replay = ring(form, 2 * slots, 2, shape, 4)
    lanes = [NaiveLane(slots, 4, shape) for _ in range(2)]
    rng = np.random.default_rng(0)
    stored: dict[Segment, np.ndarray] = {}
    for operations in (900, 3000, 2600):
        drive(replay, lanes, rng, operations)
        for segment in replay.segments():
            if segment not in stored or not segment.complete:
                stored[segment] = replay.read_segment(segment).copy()
    copy = ring(form, 2 * slots, 2, shape, 4)
    copy.load_state_dict(replay.state_dict())
    for segment in replay.segments():
        copy.load_segment(segment, stored[segment])
    compare(copy, lanes)
    one, two = (r.sample(64, np.random.default_rng(3), ONE_STEP) for r in (replay, copy))
    assert np.array_equal(one.observations, two.observations)
    assert np.array_equal(one.next_observations, two.next_observations)
    assert copy.nbytes == replay.nbytes


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.uint8, np.bool_, np.float32])
@pytest.mark.parametrize("shape", [(1, 84, 84), (6, 10, 10), (4,)])
@pytest.mark.parametrize("form", ["compressed", "device"])
def test_other_forms_equal_plain(dtype: type, shape: tuple[int, ...], form: str) -> None:
    """The same operations, samples and bytes, for frames that change little and for noise."""
    plain, other = (ring(name, 400, 2, shape, 4, dtype) for name in ("plain", form))
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 2, shape).astype(dtype) * rng.normal(size=shape).astype(dtype) for _ in range(40)]
    for replay in (plain, other):
        script = np.random.default_rng(1)
        for lane in range(2):
            replay.begin(lane, frames[0])
        for step in range(1200):
            lane, end = int(script.integers(2)), bool(script.random() < 0.05)
            replay.add(lane, step % 18, float(step), end, frames[int(script.integers(40))])
            if end:
                replay.begin(lane, frames[1])
            if step in (5, 100, 1199):
                ours = replay.sample(50, np.random.default_rng(step), ONE_STEP)
                theirs = plain.sample(50, np.random.default_rng(step), ONE_STEP) if step == 1199 else ours
                for one, two in zip(vars(ours).values(), vars(theirs).values(), strict=True):
                    assert np.array_equal(one, two)
                    assert np.asarray(one).dtype == np.asarray(two).dtype
    other.check_valid()


def test_noise_stays_below_the_cap_and_what_is_left_is_right() -> None:
    """Frames that do not compress: the oldest blocks leave, in storing and after loading alike."""
    shape, cap = (1, 16, 16), 60_000
    replay = FrameReplay(1200, 2, shape, np.uint8, 3, compressed=True, max_bytes=cap)
    rng = np.random.default_rng(0)
    frames: list[dict[float, np.ndarray]] = [{}, {}]
    for lane in range(2):
        replay.begin(lane, rng.integers(0, 256, shape, np.uint8))
    largest = 0
    for step in range(3000):
        lane, frame = int(rng.integers(2)), rng.integers(0, 256, shape, np.uint8)
        frames[lane][float(step)] = frame
        replay.add(lane, 0, step, False, frame)
        largest = max(largest, replay.nbytes - 11 * 1200)
        if step == 1500:
            copy = FrameReplay(1200, 2, shape, np.uint8, 3, compressed=True, max_bytes=cap)
            copy.load_state_dict(replay.state_dict())
            for segment in replay.segments():
                copy.load_segment(segment, replay.read_segment(segment))
            replay = copy
    assert largest <= cap
    assert 100 < len(replay) < 300, "60 kB of 256-byte frames"
    replay.check_valid()
    batch = replay.gather(replay.valid_slots(), ONE_STEP)
    for next_observation, reward in zip(batch.next_observations, batch.rewards, strict=True):
        assert any(np.array_equal(next_observation[-1:], of_lane.get(float(reward))) for of_lane in frames)


def test_sampling_is_uniform_and_seeded() -> None:
    replay = FrameReplay(40, 2, (1,), np.float32, 2)
    lanes = [NaiveLane(20, 2, (1,)) for _ in range(2)]
    for lane in range(2):
        replay.begin(lane, np.zeros(1, np.float32))
        for action in range(10 if lane else 15):
            replay.add(lane, action, 0.0, False, np.ones(1, np.float32))
    del lanes
    slots, draws = replay.valid_slots(), 50_000
    rng = np.random.default_rng(0)
    counts = np.zeros(40)
    original = replay.gather
    replay.gather = lambda chosen, _: np.add.at(counts, chosen, 1)  # type: ignore[method-assign,assignment,return-value]
    replay.sample(draws, rng, ONE_STEP)
    replay.gather = original  # type: ignore[method-assign]
    expected = draws / len(slots)
    chi2 = float(((counts[slots] - expected) ** 2 / expected).sum())
    assert counts.sum() == draws
    assert chi2 < 60, "24 degrees of freedom: 60 is beyond the 99.99th percentile"


def test_nothing_to_sample() -> None:
    with pytest.raises(ValueError, match="no transition"):
        FrameReplay(10, 1, (1,), np.float32, 1).sample(2, np.random.default_rng(0), ONE_STEP)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_many_blocks_are_read_by_two_threads(threads: int) -> None:
    rng = np.random.default_rng(0)
    plain, compressed = PlainFrames(2, 300, (5, 6), np.uint8), CompressedFrames(2, 300, (5, 6), np.uint8, 16)
    for lane in (0, 1):
        for within in range(230):
            for frames in (plain, compressed):
                frames.write(lane, within, np.full((5, 6), 7 * lane + within % 251, np.uint8))
    slots = rng.integers(0, 230, (200, 4)) + 300 * rng.integers(0, 2, (200, 4))
    slots[rng.random((200, 4)) < 0.1] = -1
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        for _ in range(5):
            assert np.array_equal(compressed.read(slots), plain.read(slots))
    finally:
        torch.set_num_threads(before)
