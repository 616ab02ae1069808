"""The health of layers in training's reports: what it is measured on, and when."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.learning.events import Measured
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.measuring import HEALTH_BATCH, layer_health, updates_to_settle
from switchmt_snn.learning.training import Training
from tests.conftest import CountingEnvironment, small_config, vector_suite


def training(network: dict[str, Any] | None = None, tasks: int = 2, **learning: Any) -> Training:
    suite = vector_suite(lambda task, n: CountingEnvironment(task, n, 7), 4, tasks)
    config = small_config(
        network=network or {},
        learning=learning,
        tasks={"names": list("ab"[:tasks])},
        recording={"metrics_every_steps": 10},
    )
    return Training(config, suite, torch.device("cpu"))


@pytest.mark.slow
def test_health_is_drawn_from_the_whole_replay_of_the_task(monkeypatch: pytest.MonkeyPatch) -> None:
    part = training()
    for _ in part.events():
        pass
    seen: list[tuple[np.ndarray, int]] = []
    rates = Learner.firing_rates
    monkeypatch.setattr(
        Learner, "firing_rates", lambda self, x, task: (seen.append((x, task)), rates(self, x, task))[1]
    )
    for step in (10, 10, 20):
        layer_health(part.learner, part.replays[1], 1, step)
    (first, task), (again, _), (other, _) = seen
    assert task == 1
    assert len(first) == HEALTH_BATCH
    assert (first[:, 0] == 1).all(), "frames of task 1"
    assert len(np.unique(first[:, 2])) > 10, "many episodes, not the newest ones only"
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.slow
def test_measuring_changes_nothing_in_training() -> None:
    often, never = training(), training()
    never.metrics_clock.period_steps = 10**9
    for part in (often, never):
        for _ in part.events():
            pass
    assert torch.equal(often.learner.parameters(), never.learner.parameters())
    for name in ("sample_rng", "explore_rng"):
        assert getattr(often, name).bit_generator.state == getattr(never, name).bit_generator.state
    assert torch.equal(often.learner.generator.get_state(), never.learner.generator.get_state())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("momentum", "every", "per_round", "first"),
    [(0.1, 1, 1, 20 + 44), (0.3, 1, 1, 20 + 13), (0.3, 2, 3, 20 + 10), (1.0, 1, 1, 20 + 1)],
)
def test_no_health_before_the_running_statistics_have_left_their_initial_values(
    momentum: float, every: int, per_round: int, first: int
) -> None:
    """(1 - momentum)^updates falls below 0.01 with the 44th update of momentum 0.1, with the 13th of 0.3."""
    part = training(
        {"stream_normalization": "batch", "normalization_momentum": momentum},
        tasks=1,
        update_every_steps=every,
        updates_per_round=per_round,
    )
    shown = {e.step for e in part.events() if isinstance(e, Measured) and e.layers}
    assert min(shown) == -(-first // 10) * 10


@pytest.mark.slow
def test_a_network_without_normalization_has_health_from_the_end_of_the_warm_up() -> None:
    part = training(tasks=1)
    assert updates_to_settle(part.learner.network) == 0
    shown = [e for e in part.events() if isinstance(e, Measured)]
    assert [bool(e.layers) for e in shown[:3]] == [False, True, True]
