"""Episodes of one task, played epsilon-greedily side by side, as typed events."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.config import EvaluationConfig
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.suite import TaskSuite

LONG_EPISODE_STEPS = 30_000
"""Episodes that are longer are announced: Atari's longest have 27,000 steps."""

QFunction = Callable[[npt.NDArray[Any], int], npt.NDArray[np.float32]]
"""Stacked observations ``[n, ...]`` and a task -> Q-values ``[n, A]``, -inf where an action does not exist."""


@dataclass(frozen=True)
class EpisodeScore:
    """One evaluation episode."""

    policy: str
    task: str
    episode: int
    seed: int
    score: float
    length_steps: int
    mean_q: float | None
    truncated: bool


@dataclass(frozen=True)
class Decided:
    """What is about to be done in every running episode; the next event follows the step.

    Attributes:
        play: in the state that was decided on (``observations``, ``picture``); valid until the next event.
        copies: the copies of the task with a running episode ``[n]``.
        q_nA: their Q-values, -inf where an action does not exist; None of random play.
        actions_n: what each will do.
        random_n: which of them were drawn at random.
    """

    play: Play
    copies: npt.NDArray[np.int64]
    q_nA: npt.NDArray[np.float32] | None
    actions_n: npt.NDArray[np.int64]
    random_n: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Stepped:
    """What the step brought.

    Attributes:
        play: after the step (``returns``, ``picture``); valid until the next event.
        copies: those of the ``Decided`` before.
        rewards_n: raw.
    """

    play: Play
    copies: npt.NDArray[np.int64]
    rewards_n: npt.NDArray[np.float64]


@dataclass(frozen=True)
class Playing:
    """How episodes are played.

    Attributes:
        seed: root of the episodes' seeds.
        epsilon: share of random actions.
        max_episode_steps: longer episodes are cut off.
        note: receives what the user should know.
        go_on: called before every step; what it raises ends the play.
        ended: called when an episode has ended.
        reseed: of decisions that draw random numbers. They are then drawn anew from an episode's seed for each of its
            decisions, so that an episode does not depend on those beside it; one decision is made after the other.
    """

    seed: int
    epsilon: float
    max_episode_steps: int = EvaluationConfig.max_episode_steps
    note: Callable[[str], None] | None = None
    go_on: Callable[[], None] | None = None
    ended: Callable[[], None] | None = None
    reseed: Callable[[int], None] | None = None


def play_episodes(
    policy: str,
    q_function: QFunction | None,
    suite: TaskSuite,
    task: int,
    numbers: Sequence[int],
    playing: Playing,
) -> list[EpisodeScore]:
    """Play episodes of a task side by side with epsilon-greedy actions.

    Args:
        policy: its name in the scores.
        q_function: None plays at random.
        suite: the tasks.
        task: index.
        numbers: of the episodes.
        playing: seed, epsilon, and the longest episode.
    """
    events = episode_events(policy, q_function, suite, task, numbers, playing)
    return sorted((event for event in events if isinstance(event, EpisodeScore)), key=lambda score: score.episode)


def episode_events(
    policy: str,
    q_function: QFunction | None,
    suite: TaskSuite,
    task: int,
    numbers: Sequence[int],
    playing: Playing,
) -> Iterator[Decided | Stepped | EpisodeScore]:
    """As ``play_episodes``, step by step: ``Decided``, ``Stepped``, and the ``EpisodeScore`` of episodes that ended."""
    play = Play(suite, task, len(numbers))
    try:
        yield from _played(policy, q_function, suite, play, numbers, playing)
    finally:
        play.close()


def _played(
    policy: str,
    q_function: QFunction | None,
    suite: TaskSuite,
    play: Play,
    numbers: Sequence[int],
    playing: Playing,
) -> Iterator[Decided | Stepped | EpisodeScore]:
    n, task = play.num_envs, play.task
    valid = np.flatnonzero(suite.valid_actions_KA[task])
    rngs = [np.random.default_rng([playing.seed, task, number]) for number in numbers]
    seeds = np.asarray([episode_seed(playing.seed, task, number) for number in numbers], np.int64)
    running, q_sums = np.ones(n, np.bool_), np.zeros(n)
    play.begin(np.arange(n), seeds)
    while running.any():
        if playing.go_on is not None:
            playing.go_on()
        explore = np.asarray([rng.random() < playing.epsilon for rng in rngs])
        actions = np.asarray([valid[rng.integers(len(valid))] for rng in rngs], np.int64)
        asked, q_nA = np.flatnonzero(running), None
        if q_function is not None:
            drawn = [(playing.seed, task, int(numbers[int(env)]), int(play.lengths_steps[env])) for env in asked]
            q_nA = _decided(q_function, play.observations[asked], task, drawn, playing.reseed)
            q_sums[asked] += q_nA.max(axis=1)
            actions[asked] = np.where(explore[asked], actions[asked], q_nA.argmax(axis=1))
        yield Decided(play, asked, q_nA, actions[asked], explore[asked] | (q_function is None))
        played = play.step(actions)
        yield Stepped(play, asked, played.rewards[asked])
        _announce(policy, suite.names[task], play.lengths_steps[running], playing)
        cut = running & (play.lengths_steps >= playing.max_episode_steps)
        for env in np.union1d(played.ended, np.flatnonzero(cut)):
            if running[env]:
                length = int(play.lengths_steps[env])
                if playing.ended is not None:
                    playing.ended()
                yield EpisodeScore(
                    policy=policy,
                    task=suite.names[task],
                    episode=numbers[env],
                    seed=int(seeds[env]),
                    score=float(play.returns[env]),
                    length_steps=length,
                    mean_q=None if q_function is None else float(q_sums[env]) / length,
                    truncated=not bool(played.terminated[env]),
                )
            running[env] = False
            # An idle copy starts its episode again, unobserved: environments must not be stepped past an end.
            play.begin(np.asarray([env]), seeds[env : env + 1])


def _decided(
    q_function: QFunction,
    observations: npt.NDArray[Any],
    task: int,
    drawn: Sequence[tuple[int, ...]],
    reseed: Callable[[int], None] | None,
) -> npt.NDArray[np.float32]:
    """Q-values ``[n, A]``; where they draw random numbers, each by itself from its entry in ``drawn``."""
    if reseed is None:
        return q_function(observations, task)
    q_values = []
    for observation, place in zip(observations, drawn, strict=True):
        reseed(int(np.random.default_rng(place).integers(2**62)))
        q_values.append(q_function(observation[None], task))
    return np.concatenate(q_values)


def _announce(policy: str, task: str, lengths_steps: npt.NDArray[np.int64], playing: Playing) -> None:
    """Say that an episode is long."""
    long = min(LONG_EPISODE_STEPS, playing.max_episode_steps)
    if playing.note is not None and lengths_steps.max() == long:
        rest = f"it is cut off after {playing.max_episode_steps:,} (evaluation.max_episode_steps)"
        if long == playing.max_episode_steps:
            rest = "it is cut off here (evaluation.max_episode_steps), with the return that it has"
        playing.note(f"{task}: an episode of the {policy} policy has not ended after {long:,} steps; {rest}")
