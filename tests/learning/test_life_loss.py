"""A lost life is terminal for the learner only: the replay says so, and nothing else changes."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.events import EpisodeEnded
from switchmt_snn.learning.training import Training
from switchmt_snn.replay.ring import Returns
from switchmt_snn.runs.plan import plan
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import VectorStep
from tests.conftest import CountingEnvironment, small_config, vector_suite
from tests.learning.resuming import assert_continues_exactly

LENGTH = 8


class MortalEnvironment(CountingEnvironment):
    """Loses a life at every third step of an episode; in task 1 there are no lives."""

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        played = super().step(actions)
        lost = None if self._task == 1 else self._steps % 3 == 0
        return VectorStep(played.frames, played.rewards, played.terminated, played.truncated, lost)


def training(terminal: bool) -> Training:
    config = small_config(
        tasks={"num_envs": 2},
        learning={"life_loss_is_terminal": terminal, "clip_rewards": False, "epsilon_end": 1.0, "n_steps": 3},
    )
    return Training(config, vector_suite(lambda task, n: MortalEnvironment(task, n, LENGTH), 4, stack=3), CPU)


CPU = torch.device("cpu")


@pytest.mark.slow
def test_sums_stop_at_a_lost_life_and_equal_the_naive_ones() -> None:
    """Frames say the step t (reward t + 1) and the episode's seed (odd ones terminate at the end)."""
    part = training(terminal=True)
    for _ in part.events():
        pass
    compared = 0
    for task, replay in enumerate(part.replays):
        slots = replay.valid_slots()
        batch = replay.gather(slots, Returns(n_steps=3, discount=0.5))
        now, after = (
            np.asarray(x).reshape(len(slots), 3, 4)[:, -1] for x in (batch.observations, batch.next_observations)
        )
        newest: dict[tuple[int, int], int] = defaultdict(int)
        for env, seed, t in np.asarray(replay.gather(slots, Returns()).next_observations)[:, -3:].astype(int).tolist():
            newest[env, seed] = max(newest[env, seed], t)
        for i, (t, seed, env) in enumerate(now[:, [3, 2, 1]].astype(int).tolist()):
            total, steps, terminal = 0.0, 0, False
            while steps < 3 and not terminal and t + steps < newest[env, seed]:
                total += 0.5**steps * (t + steps + 1)
                steps += 1
                dies = task == 0 and (t + steps) % 3 == 0
                terminal = dies or (t + steps == LENGTH and seed % 2 == 1)
            assert batch.rewards[i] == pytest.approx(total)
            assert (batch.terminated[i], batch.discounts[i]) == (terminal, 0.5**steps)
            assert after[i, 3] == t + steps
            compared += 1
    assert compared > 150


@pytest.mark.slow
def test_stacks_returns_and_episodes_are_those_without_the_setting() -> None:
    with_it, without = training(terminal=True), training(terminal=False)
    logs: list[list[Any]] = [[e for e in part.events() if isinstance(e, EpisodeEnded)] for part in (with_it, without)]
    assert logs[0] == logs[1]
    assert {e.length_steps for e in logs[0]} == {LENGTH}
    for ours, theirs in zip(with_it.replays, without.replays, strict=True):
        assert np.array_equal(ours.valid_slots(), theirs.valid_slots())
        one, other = (replay.gather(replay.valid_slots(), Returns()) for replay in (ours, theirs))
        for name in ("observations", "actions", "rewards", "next_observations", "discounts"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
    flags = [part.replays[0].gather(part.replays[0].valid_slots(), Returns()).terminated for part in (with_it, without)]
    assert flags[0].sum() > flags[1].sum() > 0
    assert not torch.equal(with_it.learner.parameters(), without.learner.parameters())


@pytest.mark.slow
def test_a_run_whose_lives_are_terminal_continues_exactly() -> None:
    assert_continues_exactly(lambda: training(terminal=True), at_steps=(4, 54, 272))


@pytest.mark.slow
def test_breakout_is_terminal_where_lives_fall_and_its_episodes_are_the_same() -> None:
    logs, flags = [], []
    for terminal in (True, False):
        config = small_config(
            total_steps=1500,
            tasks={"suite": "atari", "names": ["breakout"], "num_envs": 3, "frame_stack": 4},
            network={"trunk": "nature", "timesteps": 1},
            learning={"life_loss_is_terminal": terminal, "learning_starts_steps": 2000, "replay_capacity_steps": 2100},
        )
        part = Training(config, make_suite(config.tasks), CPU)
        logs.append([event for event in part.events() if isinstance(event, EpisodeEnded)])
        flags.append([lane.copy() for lane in part.replays[0]._by_lane(part.replays[0]._terminated)])
        part.close()
    assert logs[0] == logs[1]
    assert len(logs[0]) >= 3
    for with_it, without in zip(*flags, strict=True):
        ends = np.flatnonzero(without)
        assert with_it[ends].all()
        for first, last in zip([-1, *ends], ends, strict=False):
            assert with_it[first + 1 : last + 1].sum() == 5, "Breakout has five lives"


@pytest.mark.parametrize(
    ("suite", "names"), [("minatar", ["breakout"]), ("gym", ["CartPole-v1"]), ("atari", ["pong", "enduro"])]
)
def test_tasks_without_lives_refuse_it_by_name(suite: str, names: list[str]) -> None:
    config = small_config(tasks={"suite": suite, "names": names}, learning={"life_loss_is_terminal": True})
    with pytest.raises(ConfigError, match=rf"life_loss_is_terminal .* without lives \({', '.join(names)}\)"):
        plan(config)
