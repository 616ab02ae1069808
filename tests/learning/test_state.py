"""A saved state that is not whole, or of another run, is one line, wherever it lacks something."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.errors import CheckpointError
from switchmt_snn.learning.training import Training
from switchmt_snn.runs.checkpoint import fitting_weights
from tests.conftest import CountingEnvironment, small_config, vector_suite

CPU = torch.device("cpu")


def training(first_layer_mean: str = "input") -> Training:
    config = small_config(
        network={"mlp_normalization": "batch"},
        learning={"first_layer_mean": first_layer_mean, "return_normalization": "per_task"},
    )
    return Training(config, vector_suite(lambda task, n: CountingEnvironment(task, n, 7), 4), CPU)


def played(**settings: Any) -> dict[str, Any]:
    part = training(**settings)
    for _ in part.events():
        pass
    state: dict[str, Any] = part.state_dict()
    return state


@pytest.fixture(scope="module")
def state() -> dict[str, Any]:
    return played()


def places(value: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """All keys of a nested state; what the optimizer keeps of one parameter is PyTorch's own."""
    if isinstance(value, dict) and place[-2:] != ("optimizer", "state"):
        for key, item in value.items():
            yield (*place, key)
            yield from places(item, (*place, key))


def at(state: dict[str, Any], place: tuple[str, ...]) -> dict[str, Any]:
    for key in place:
        state = state[key]
    return state


@pytest.mark.slow
def test_whatever_is_missing_is_one_line(state: dict[str, Any]) -> None:
    accepted, messages = set(), {}
    part, damaged = training(), copy.deepcopy(state)
    for place in places(state):
        parent = at(damaged, place[:-1])
        items = list(parent.items())
        del parent[place[-1]]
        try:
            with fitting_weights():
                part.load_state_dict(damaged)
            accepted.add(place)
        except CheckpointError as error:
            messages[place] = str(error)
        parent.clear()
        parent.update(items)
    assert {place for place, text in messages.items() if "\n" in text or "expected" not in text} == set()
    # What states of older versions lack; a task that is not being played need not be in play.
    assert accepted == {
        ("updates_in_visit",),
        ("exploration",),
        ("policy", "criterion", "updates"),
        ("plays", "0"),
    }


Damage = Callable[[dict[str, Any]], None]
DAMAGES: list[tuple[Damage, str]] = [
    (lambda s: s.update(replays={}), "has no 0, 1 of replays of Training"),
    (lambda s: s.update(replays=[]), "has a list as the state of replays of Training"),
    (lambda s: s["learner"].update(loss_sum=torch.zeros(3)), r"a Tensor of shape \(3,\) as loss_sum of Learner"),
    (lambda s: s["learner"].update(generator=torch.zeros(3)), "as generator of Learner, expected the state of such a"),
    (lambda s: s["learner"]["first_layer"]["inputs"].pop(), "a list of 1 as inputs of FirstLayerMeans, expected a"),
    (
        lambda s: s["learner"]["first_layer"].update(inputs=[torch.zeros(2)] * 2),
        r"shape \(2,\) as number 0 of inputs of FirstLayerMeans, expected a Tensor of shape \(4,\)",
    ),
    (
        lambda s: s["learner"]["optimizer"].update(param_groups=[]),
        "param_groups of optimizer of Learner, expected one group",
    ),
    (lambda s: s.update(explore_rng={"state": 3}), "as explore_rng of Training, expected the state of such a random"),
    (lambda s: s["replays"]["0"].update(written=np.zeros(2)), r"written of shape \(2,\) .* expected \(1,\)"),
    (
        lambda s: s["replays"]["1"].update(age=np.zeros(1)),
        r"has age of shape \(1,\) and type float64 of FrameReplay, expected",
    ),
    (lambda s: s["plays"]["0"].update(seeds=np.zeros(5)), "as seeds of running episodes, expected whole numbers"),
    (
        lambda s: s["plays"]["0"].update(seeds=np.zeros(5, np.int64)),
        "has 5 seeds and 1 lists of actions of a task, expected 1",
    ),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGES)
def test_what_does_not_fit_is_one_line(state: dict[str, Any], damage: Damage, message: str) -> None:
    damaged = copy.deepcopy(state)
    damage(damaged)
    with pytest.raises(CheckpointError, match=message) as error:
        training().load_state_dict(damaged)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_run_without_first_layer_means_does_not_continue_with_them() -> None:
    with pytest.raises(CheckpointError, match="has no first_layer of Learner, expected what it saves"):
        training().load_state_dict(played(first_layer_mean="running"))
