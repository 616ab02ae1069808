"""Whether a suite's environments do what the suite says; for authors of suites, and used by the tests."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt

from switchmt_snn.config import ExperimentConfig, clips_rewards
from switchmt_snn.config.plugins import is_plugin
from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.gym_make import make_environment
from switchmt_snn.tasks.gym_spaces import dim_pixels, rounding
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.suite import TaskSuite

STEPS_BEFORE_TRAINING = 20
"""Steps per task for which tasks from outside are played before a run starts."""

FROM_ITS_SEED = (
    "take every random number from self.np_random, which super().reset(seed=seed) seeds, and set everything else anew "
    "in reset"
)
"""What makes an episode a function of its seed."""


@contextmanager
def warnings_unless_refused() -> Iterator[None]:
    """Show the warnings of a block (Gymnasium's checker) after it, and none if it raises: a refusal is one line."""
    with warnings.catch_warnings(record=True) as caught:
        yield
    for shown in dict.fromkeys((str(seen.message), seen.category, seen.filename, seen.lineno) for seen in caught):
        warnings.warn_explicit(*shown)


def check_before_training(config: ExperimentConfig, tasks: TaskSuite) -> tuple[str, ...]:
    """Play tasks from outside the package for a few steps, twice; a suite must repeat itself, as in ``check_suite``.

    Args:
        config: names the suite, and says how its rewards are learned from.
        tasks: what ``make_suite(config.tasks)`` returned.

    Returns:
        what the user should know: Gymnasium environments that do not repeat themselves, or whose rewards are clipped.

    Raises:
        TaskError: naming the task, what was seen, and what was expected.
    """
    notes = []
    suite, helping = config.tasks.suite, " or a Huber loss" if config.learning.loss == "mse" else ""
    if is_plugin(suite):
        check_suite(tasks, STEPS_BEFORE_TRAINING)
    elif suite == "gym":
        for task, name in enumerate(tasks.names):
            first, second = (journal(tasks, task, STEPS_BEFORE_TRAINING) for _ in range(2))
            largest = max(float(np.abs(seen[1]).max()) for seen in first[1:])
            if clips_rewards(config) and largest > 1:
                notes.append(
                    f"warning: task {name!r} gave rewards up to {largest:g}, and learning.clip_rewards=true clips them "
                    "to [-1, 1] for learning, which changes what is best; learning.clip_rewards=false learns from them "
                    f"as they are (smaller rewards{helping} then help)"
                )
            seen_values = max(float(np.abs(seen[0]).max()) for seen in first)
            made = make_environment(name, config.tasks.wrappers)
            texts = rounding(made.observation_space, 0.0), dim_pixels(tasks.scale, seen_values)
            made.close()
            notes += [f"warning: task {name!r}: {text}" for text in texts if text is not None]
            step = differs_from(first, second)
            if step is not None:
                notes.append(
                    f"warning: task {name!r} differs at step {step} when it is played again with the same seed and "
                    f"actions: evaluations do not repeat, and a resumed run is not exact; {FROM_ITS_SEED}"
                )
            elif not starts_afresh(tasks, task, STEPS_BEFORE_TRAINING):
                notes.append(
                    f"warning: task {name!r} plays an episode otherwise after other episodes than in an environment "
                    "made anew, with the same seed and actions: evaluations depend on their number of copies, and a "
                    f"resumed run is not exact; {FROM_ITS_SEED}"
                )
    return tuple(notes)


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
        step = differs_from(*(journal(tasks, task, steps) for _ in range(2)))
        if step is not None:
            raise TaskError(
                f"task {name!r} differs at step {step} when it is played again, expected the same frames, rewards and "
                "ends for the same seed and actions; take every random number from reset's seed"
            )


Journal = list[tuple[npt.NDArray[np.generic], ...]]
"""First frames, then observations, rewards and ends of every step."""


def journal(tasks: TaskSuite, task: int, steps: int, seed: int = 0, actions_seed: int = 0) -> Journal:
    """A random play of two copies in environments made anew: every valid action once, then random ones.

    Raises:
        TaskError: the environment fails, or is not what its suite says.
    """
    rng, valid, episodes = np.random.default_rng(actions_seed), np.flatnonzero(tasks.valid_actions_KA[task]), 2
    play = Play(tasks, task, 2)
    try:
        start = play.begin(np.arange(2), np.asarray([episode_seed(seed, task, episode) for episode in range(2)]))
        seen: Journal = [(start.copy(),)]
        for step in range(steps):
            actions = valid[[step, step]] if step < len(valid) else rng.choice(valid, 2)
            result = play.step(actions)
            seen.append((play.observations.copy(), result.rewards, result.terminated, result.truncated))
            for env in result.ended:
                play.begin(np.asarray([env]), np.asarray([episode_seed(seed, task, episodes)]))
                episodes += 1
        return seen
    finally:
        play.close()


def starts_afresh(tasks: TaskSuite, task: int, steps: int, seed: int = 0) -> bool:
    """Whether an episode's first steps are the same after another episode as in an environment made anew."""
    play = Play(tasks, task, 1)
    try:
        valid = np.flatnonzero(tasks.valid_actions_KA[task])
        anew = one_episode(play, valid, seed, steps)
        return differs_from(anew, one_episode(play, valid, seed, steps)) is None
    finally:
        play.close()


def one_episode(play: Play, valid: npt.NDArray[np.int64], seed: int, steps: int) -> Journal:
    """The first steps of an episode of a fixed seed with fixed actions, in a play of one copy."""
    rng = np.random.default_rng(seed)
    seen: Journal = [(play.begin(np.zeros(1, np.int64), np.asarray([episode_seed(seed, play.task, 0)])).copy(),)]
    for _ in range(steps):
        result = play.step(rng.choice(valid, 1))
        seen.append((result.frames.copy(), result.rewards, result.terminated, result.truncated))
        if len(result.ended):
            break
    return seen


def differs_from(first: Journal, second: Journal) -> int | None:
    """The first step at which two plays differ; None if they are the same."""
    for step, (one, two) in enumerate(zip(first, second, strict=False)):
        if not all(np.array_equal(a, b) for a, b in zip(one, two, strict=True)):
            return step
    return None if len(first) == len(second) else min(len(first), len(second))
