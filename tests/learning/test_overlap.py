"""Environments that step while an update runs: bitwise the loop without a second thread."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.config import resolve
from switchmt_snn.config.yaml_io import from_dict
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.training import Training
from switchmt_snn.replay.ring import Returns
from switchmt_snn.tasks.play import Play
from switchmt_snn.tasks.registry import make_suite


class Lazily:
    """A step that runs when its result is asked for, which is after the update, on the same thread."""

    def __init__(self, play: Any, actions: Any) -> None:
        self.result = lambda: play.step(actions)


def immediately(play: Any, actions: Any) -> Future[Any]:
    """A step that has run before the update begins, on the same thread."""
    done: Future[Any] = Future()
    done.set_result(play.step(actions))
    return done


def training(overlap: bool) -> Training:
    config = resolve(
        from_dict(
            {
                "total_steps": 800,
                "device": "cpu",
                "tasks": {"suite": "minatar", "names": ["breakout", "asterix"], "num_envs": 2, "frame_stack": 2},
                "network": {"hidden_units": 16, "timesteps": 2, "encoding": "rate"},
                "learning": {
                    "batch_size": 8,
                    "learning_starts_steps": 40,
                    "replay_capacity_steps": 200,
                    "update_every_steps": 2,
                    "target_update_every_steps": 100,
                    "epsilon_decay_steps": 400,
                    "overlap": overlap,
                },
                "switching": {"window_episodes": 2, "max_stay_steps": 150},
            }
        )
    )
    return Training(config, make_suite(config.tasks), torch.device("cpu"))


@pytest.mark.slow
def test_the_other_thread_changes_nothing_at_any_step(monkeypatch: pytest.MonkeyPatch) -> None:
    trainings = [training(overlap=True) for _ in range(3)]
    monkeypatch.setattr(trainings[1], "_step_on_thread", immediately)
    monkeypatch.setattr(trainings[2], "_step_on_thread", Lazily)
    steps = 0
    for events in zip(*(each.events() for each in trainings), strict=True):
        assert events[0] == events[1] == events[2]
        parameters = [each.learner.parameters() for each in trainings]
        assert torch.equal(parameters[0], parameters[1])
        assert torch.equal(parameters[0], parameters[2])
        steps += 1
    assert steps > 400
    assert trainings[0].learner.updates > 300
    replays = [[replay.gather(replay.valid_slots(), Returns()) for replay in each.replays] for each in trainings]
    for one, other in zip(replays[0], replays[1], strict=True):
        assert np.array_equal(one.observations, other.observations)
        assert np.array_equal(one.actions, other.actions)
    for each in trainings:
        each.close()


def test_the_environments_step_while_the_update_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each waits for the other to have begun: on one thread this would wait in vain."""
    stepping, updating = threading.Event(), threading.Event()
    met: list[bool] = []
    step, update = Play.step, Learner.update

    def slow_step(self: Play, actions: Any) -> Any:
        stepping.set()
        if part.learner.updates == 5:
            met.append(updating.wait(20))
        return step(self, actions)

    def slow_update(self: Learner, batch: Any, task: int) -> None:
        if self.updates == 5 and not met:
            updating.set()
            assert stepping.wait(20)
        update(self, batch, task)

    monkeypatch.setattr(Play, "step", slow_step)
    monkeypatch.setattr(Learner, "update", slow_update)
    part = training(overlap=True)
    for _ in part.events():
        if met:
            break
    part.close()
    assert met[0]


@pytest.mark.slow
def test_without_overlap_the_paper_order_stays() -> None:
    """Other parameters, because an update samples with the newest transition, and acts come after it."""
    plain, beside = training(overlap=False), training(overlap=True)
    for part in (plain, beside):
        for _ in part.events():
            pass
        part.close()
    assert plain.learner.updates >= beside.learner.updates > 300
    assert not torch.equal(plain.learner.parameters(), beside.learner.parameters())
    assert plain._thread is None
