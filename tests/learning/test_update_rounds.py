"""When updates are made, how many follow each other, and when the target network is copied."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from switchmt_snn.config import LearningConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.events import Stepped
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.training import Training
from tests.conftest import CountingEnvironment, small_config, vector_suite
from tests.learning.resuming import assert_continues_exactly


def training(**learning: Any) -> Training:
    suite = vector_suite(lambda task, n: CountingEnvironment(task, n, 7), 4)
    return Training(small_config(learning=learning), suite, torch.device("cpu"))


@pytest.mark.slow
@pytest.mark.parametrize("overlap", [False, True])
@pytest.mark.parametrize("update_tasks", ["current", "all"])
def test_a_round_makes_its_number_of_updates_for_each_of_its_tasks(update_tasks: str, overlap: bool) -> None:
    part = training(update_every_steps=8, updates_per_round=5, update_tasks=update_tasks, overlap=overlap)
    before = 0
    for event in part.events():
        if isinstance(event, Stepped):
            made, before = part.learner.updates - before, part.learner.updates
            warm = [task for task in range(2) if not part.is_warming_up(task)]
            tasks = len(warm) if update_tasks == "all" else int(event.task in warm)
            if event.step % 8:
                assert made == 0, f"no round is due at step {event.step}"
            elif event.step > 200:  # both buffers are warm
                assert made == 5 * tasks > 0
    part.close()
    assert part.learner.updates % 5 == 0


@pytest.mark.slow
def test_one_round_of_many_updates_is_not_many_rounds_of_one() -> None:
    """Both make the same number of updates; within a round nothing new is played."""
    often, seldom = training(update_every_steps=1), training(update_every_steps=50, updates_per_round=50)
    for part in (often, seldom):
        for _ in part.events():
            pass
    assert seldom.learner.updates > 200
    assert not torch.equal(often.learner.parameters(), seldom.learner.parameters())


@pytest.mark.slow
def test_target_copies_are_counted_in_updates_of_all_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    part = training(
        update_every_steps=4, updates_per_round=3, update_tasks="all", target_update_every_updates=7, overlap=True
    )
    copied_at: list[int] = []
    copy = Learner.copy_target
    monkeypatch.setattr(Learner, "copy_target", lambda self: (copied_at.append(self.updates), copy(self))[1])
    for _ in part.events():
        pass
    part.close()
    assert copied_at == list(range(7, part.learner.updates + 1, 7))
    assert len(copied_at) > 30


@pytest.mark.slow
def test_target_copies_are_counted_in_steps_without_a_number_of_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    part, copied_at = training(target_update_every_steps=50, updates_per_round=3), []
    monkeypatch.setattr(Learner, "copy_target", lambda self: copied_at.append(part.steps))
    for _ in part.events():
        pass
    assert copied_at == list(range(50, 401, 50))


@pytest.mark.slow
@pytest.mark.parametrize("update_tasks", ["current", "all"])
def test_rounds_and_copies_counted_in_updates_continue_exactly(update_tasks: str) -> None:
    settings = {"update_every_steps": 8, "updates_per_round": 5, "update_tasks": update_tasks}
    assert_continues_exactly(lambda: training(**settings, target_update_every_updates=13), at_steps=(3, 155, 271))


@pytest.mark.parametrize("name", ["updates_per_round", "target_update_every_updates"])
def test_counts_below_one_are_refused_by_name(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"learning\.{name} is 0, expected at least 1"):
        LearningConfig(**{name: 0})
