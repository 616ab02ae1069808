"""Whether a suite's environments do what the suite says; for authors of suites, and used by the tests."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from switchmt_snn.config import TasksConfig
from switchmt_snn.config.plugins import is_plugin
from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.suite import TaskSuite

STEPS_BEFORE_TRAINING = 20
"""Steps per task for which tasks from outside are played before a run starts."""


def check_before_training(config: TasksConfig, tasks: TaskSuite) -> None:
    """Play tasks from outside the package for a few steps: a suite as ``check_suite`` does, Gymnasium's once.

    Args:
        config: names the suite.
        tasks: what ``make_suite(config)`` returned.

    Raises:
        TaskError: naming the task, what was seen, and what was expected.
    """
    if is_plugin(config.suite):
        check_suite(tasks, STEPS_BEFORE_TRAINING)
    elif config.suite == "gym":
        for task in range(len(tasks.names)):
            _played(tasks, task, STEPS_BEFORE_TRAINING)


def check_suite(tasks: TaskSuite, steps: int = 200) -> None:
    """Play every task at random in two copies, twice, and compare the play with the suite's facts.

    Checked: the environments have ``num_envs`` and every method; rewards and ends have a value per copy; shape and
    dtype of frames; the range of scaled frames; every valid action is taken; and an episode is the same again for the
    same seed and the same actions, which exact resume needs.

    Args:
        tasks: what ``make_suite(config)`` returned.
        steps: steps per task.

    Raises:
        TaskError: naming the task, what was seen, and what was expected.
    """
    for task, name in enumerate(tasks.names):
        first, second = (_played(tasks, task, steps) for _ in range(2))
        for step, (one, two) in enumerate(zip(first, second, strict=True)):
            if not all(np.array_equal(a, b) for a, b in zip(one, two, strict=True)):
                raise TaskError(
                    f"task {name!r} differs at step {step} when it is played again, expected the same frames, rewards "
                    "and ends for the same seed and actions; take every random number from reset's seed"
                )


def _played(tasks: TaskSuite, task: int, steps: int) -> list[tuple[npt.NDArray[np.generic], ...]]:
    """First frames, then observations, rewards and ends of every step of two copies."""
    rng, valid, episodes = np.random.default_rng(0), np.flatnonzero(tasks.valid_actions_KA[task]), 2
    play = Play(tasks, task, 2)
    try:
        start = play.begin(np.arange(2), np.asarray([episode_seed(0, task, episode) for episode in range(2)]))
        journal: list[tuple[npt.NDArray[np.generic], ...]] = [(start.copy(),)]
        for step in range(steps):
            # Every valid action once, then random ones.
            actions = valid[[step, step]] if step < len(valid) else rng.choice(valid, 2)
            result = play.step(actions)
            journal.append((play.observations.copy(), result.rewards, result.terminated, result.truncated))
            for env in result.ended:
                play.begin(np.asarray([env]), np.asarray([episode_seed(0, task, episodes)]))
                episodes += 1
        return journal
    finally:
        play.close()
