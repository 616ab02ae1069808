"""Epsilon-greedy, and random actions that last."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.config import LearningConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.exploration import Exploration
from switchmt_snn.learning.training import Training
from tests.conftest import CountingEnvironment, small_config, vector_suite
from tests.learning.resuming import assert_continues_exactly

VALID = np.asarray([0, 2, 3, 5])


def training(**learning: Any) -> Training:
    suite = vector_suite(lambda task, n: CountingEnvironment(task, n, 7), 4)
    return Training(small_config(learning=learning), suite, torch.device("cpu"))


def test_of_one_step_it_draws_what_it_has_always_drawn() -> None:
    """The golden runs rest on it."""
    ours, theirs = np.random.default_rng(3), np.random.default_rng(3)
    part = Exploration([1], 6)
    for _ in range(50):
        explores, actions = part.choose(0, VALID, 0.3, ours)
        assert np.array_equal(explores, theirs.random(6) < 0.3)
        assert np.array_equal(actions, VALID[theirs.integers(0, 4, 6)])


def chosen(longest: int, epsilon: float, steps: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    part, rng = Exploration([1, longest], 4), np.random.default_rng(1)
    explores, actions = zip(*(part.choose(1, VALID, epsilon, rng) for _ in range(steps)), strict=True)
    return np.stack(explores), np.stack(actions)


@pytest.mark.slow
def test_durations_follow_the_zeta_distribution() -> None:
    """With epsilon 1 an action begins when the last one ends; equal neighbours are rare with many actions."""
    part, rng = Exploration([20], 1), np.random.default_rng(0)
    many = np.arange(10_000)
    explores, actions = zip(*(part.choose(0, many, 1.0, rng) for _ in range(60_000)), strict=True)
    assert np.stack(explores).all()
    flat = np.stack(actions)[:, 0]
    durations = np.diff(np.flatnonzero(np.diff(flat, prepend=-1) != 0))
    assert durations.max() == 20
    weights = 1.0 / np.arange(1, 10**6) ** 2.0
    for steps in (1, 2, 3):
        expected = weights[steps - 1] / weights.sum()
        assert abs((durations == steps).mean() - expected) < 5 * (expected / len(durations)) ** 0.5
    assert abs((durations == 20).mean() - weights[19:].sum() / weights.sum()) < 0.01


@pytest.mark.slow
def test_epsilon_is_the_probability_of_beginning() -> None:
    explores, actions = chosen(100, 0.05, 20_000)
    begins = explores & ~np.roll(explores, 1, axis=0)
    idle = (~np.roll(explores, 1, axis=0)).sum()
    assert abs(begins.sum() / idle - 0.05) < 0.005
    assert explores.mean() > 1.5 * 0.05  # they last
    assert set(np.unique(actions[explores])) == set(VALID)


def test_copies_and_tasks_are_held_apart_and_an_episodes_end_ends_it() -> None:
    part = Exploration([1000, 1000], 3)
    part.left_KN[0], part.actions_KN[0] = [5, 0, 2], [3, 0, 5]
    rng = np.random.default_rng(0)
    explores, actions = part.choose(0, VALID, 0.0, rng)
    assert explores.tolist() == [True, False, True]
    assert actions[[0, 2]].tolist() == [3, 5]
    assert part.choose(1, VALID, 0.0, rng)[0].tolist() == [False] * 3
    part.end(0, 0)
    assert part.choose(0, VALID, 0.0, rng)[0].tolist() == [False, False, True]
    assert not part.choose(0, VALID, 0.0, rng)[0].any()


@pytest.mark.slow
def test_an_episodes_end_in_training_ends_it() -> None:
    part = training(longest_random_action_steps=1000)
    held = []
    for _ in part.events():
        for task, play in part._plays.items():
            held += [
                (int(play.lengths_steps[env]), int(part.exploration.left_KN[task, env])) for env in range(part.num_envs)
            ]
    assert any(left > 0 for _, left in held)
    assert all(left == 0 for length, left in held if length == 0)


@pytest.mark.slow
def test_a_run_continues_exactly() -> None:
    assert_continues_exactly(lambda: training(longest_random_action_steps=30), at_steps=(61, 155))


def test_each_task_has_its_own_longest() -> None:
    """A task of one step draws as if no other lasted."""
    part, rng, alone = Exploration([1, 50], 4), np.random.default_rng(5), np.random.default_rng(5)
    for _ in range(30):
        explores, actions = part.choose(0, VALID, 0.5, rng)
        assert np.array_equal(explores, alone.random(4) < 0.5)
        assert np.array_equal(actions, VALID[alone.integers(0, 4, 4)])
    longest = max(int(part.left_KN[1].max()) for _ in range(200) if part.choose(1, VALID, 1.0, rng)[0].all())
    assert 2 <= longest < 50
    assert not part.left_KN[0].any()


def test_training_gives_each_task_its_own_longest() -> None:
    assert training(longest_random_action_steps=9).exploration.longest_K_steps == (9, 9)
    by_task = training(longest_random_action_steps=9, longest_random_action_steps_by_task=(1, 30))
    assert by_task.exploration.longest_K_steps == (1, 30)


@pytest.mark.parametrize(
    ("by_task", "says"),
    [
        ((0, 3), r"learning\.longest_random_action_steps_by_task is \[0, 3\], expected at least 1"),
        ((3,), r"learning\.longest_random_action_steps_by_task is \[3\], expected a number of steps for each of"),
    ],
)
def test_steps_by_task_that_fit_no_tasks_are_refused(by_task: tuple[int, ...], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        small_config(learning={"longest_random_action_steps_by_task": by_task})


def test_less_than_one_step_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"learning\.longest_random_action_steps is 0, expected at least 1"):
        LearningConfig(longest_random_action_steps=0)
