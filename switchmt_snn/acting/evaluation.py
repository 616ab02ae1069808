"""Evaluation: episodes of each task under a stated protocol, raw scores, and scores relative to known ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from switchmt_snn.config import EvaluationConfig, TasksConfig
from switchmt_snn.config.numbers import exact
from switchmt_snn.machine.cores import parts
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.registry import suite_of
from switchmt_snn.tasks.suite import TaskSuite

LONG_EPISODE_STEPS = 30_000
"""Episodes that are longer are announced: Atari's longest have 27,000 steps."""

QFunction = Callable[[npt.NDArray[Any], int], npt.NDArray[np.float32]]
"""Stacked observations ``[n, ...]`` and a task -> Q-values ``[n, A]``, -inf where an action does not exist."""


class EvaluationStopped(Exception):
    """An evaluation ended early because its caller asked for it."""


class DecisionMaker(Protocol):
    """What an evaluation needs of an agent: the trained network is one, an exported file another."""

    suite: TaskSuite
    step: int

    @property
    def draws(self) -> bool:
        """Whether decisions draw random numbers (a random encoding), even greedy ones."""

    def independent(self) -> DecisionMaker:
        """The same agent for another thread: it shares nothing with this one that changes."""

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of a random encoding."""

    def q_values(self, observation: npt.NDArray[Any], task: str | int) -> npt.NDArray[np.float32]:
        """Q-values ``[B, A]`` of stacked observations ``[B, ...]`` of a task (name or index).

        -inf where an action does not exist.
        """


class KnownEpisodes(Protocol):
    """Episodes of random play that were played before."""

    def read(self, task: str) -> list[EpisodeScore] | None:
        """All episodes of a task, in order; None if they are not known."""

    def keep(self, task: str, episodes: list[EpisodeScore]) -> None:
        """Take the episodes of a task that were played now."""


@dataclass(frozen=True)
class EvaluationProtocol:
    """Everything that a score depends on, apart from the agent; printed with every score.

    Attributes:
        episodes: per task.
        epsilon: share of random actions.
        seed: root of the episodes' seeds and of the random actions.
        num_envs: episodes that are played side by side.
        suite: value of ``tasks.suite``.
        max_episode_steps: an episode that has not ended after so many steps is cut off, with the return that it has.
        environment: the suite's conditions of play in words, as ``sticky actions 0.25``.
        score: what is summed.
    """

    episodes: int
    epsilon: float
    seed: int
    num_envs: int
    suite: str
    environment: tuple[str, ...] = ()
    score: str = "raw return, unclipped"
    max_episode_steps: int = EvaluationConfig.max_episode_steps

    @classmethod
    def of(cls, evaluation: EvaluationConfig, tasks: TasksConfig) -> EvaluationProtocol:
        """The protocol that a config describes."""
        return cls(
            episodes=evaluation.episodes,
            epsilon=evaluation.epsilon,
            seed=evaluation.seed,
            num_envs=min(evaluation.num_envs, evaluation.episodes),
            suite=tasks.suite,
            max_episode_steps=evaluation.max_episode_steps,
            environment=suite_of(tasks).protocol,
        )

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> EvaluationProtocol:
        """The protocol in a stored evaluation; before version 0.2, every file had the settings of Atari as fields."""
        own = {field.name: stored[field.name] for field in fields(cls) if field.name in stored}
        if "environment" in stored:
            return cls(**{**own, "environment": tuple(stored["environment"])})
        settings = {field.name: stored[field.name] for field in fields(TasksConfig) if field.name in stored}
        return cls(**own, environment=suite_of(TasksConfig(**settings)).protocol)

    def __str__(self) -> str:
        played = [
            f"{self.episodes} episodes per task",
            f"epsilon {exact(self.epsilon)}",
            self.score,
            f"seed {self.seed}",
        ]
        if self.max_episode_steps != EvaluationConfig.max_episode_steps:
            played.append(f"episodes of at most {self.max_episode_steps:,} steps")
        return ", ".join([*played, *self.environment])


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
class TaskScore:
    """Summary of a task's episodes; ``human_normalized`` is ``(mean - random) / (human - random)`` of Wang 2016."""

    policy: str
    task: str
    episodes: int
    mean: float
    median: float
    standard_error: float | None
    human_normalized: float | None
    mean_length_steps: float
    mean_q: float | None


@dataclass(frozen=True)
class Evaluation:
    """Scores of an agent, and of the random policy under the same protocol."""

    protocol: EvaluationProtocol
    step: int
    tasks: tuple[TaskScore, ...]
    episodes: tuple[EpisodeScore, ...]

    def score(self, task: str, policy: str = "agent") -> TaskScore:
        """The summary row of a task."""
        return next(row for row in self.tasks if row.task == task and row.policy == policy)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, without the single episodes."""
        return {"step": self.step, "protocol": asdict(self.protocol), "tasks": [asdict(row) for row in self.tasks]}


def evaluate_agent(
    agent: DecisionMaker,
    protocol: EvaluationProtocol,
    tasks: tuple[str, ...] | None = None,
    note: Callable[[str], None] | None = None,
    stop: Callable[[], bool] | None = None,
    random_play: KnownEpisodes | None = None,
) -> Evaluation:
    """Play ``protocol.episodes`` episodes of each task with the agent and with the random policy.

    Deterministic for a protocol: an episode's environment and its random actions come from (seed, task, episode), and
    ``protocol.num_envs`` episodes are played side by side. The groups are spread over all cores if the suite's
    environments may run in several threads (``TaskSuite.thread_safe``); others run in the calling thread only.

    Args:
        agent: who plays.
        protocol: how.
        tasks: names; None means all.
        note: receives what the user should know meanwhile: episodes that do not end.
        stop: asked at every step; the evaluation ends when it says so.
        random_play: episodes of the random policy that are known under this protocol; None plays them.

    Raises:
        TaskError: a task is not one of the agent's, or its environment fails.
        EvaluationStopped: ``stop`` said so.
    """
    suite = agent.suite
    names = tasks or suite.names
    read = {} if random_play is None else {name: random_play.read(name) for name in names}
    known = [episode for episodes in read.values() for episode in episodes or ()]
    groups = [
        (policy, suite.index(name), range(first, min(first + protocol.num_envs, protocol.episodes)))
        for policy in ("agent", "random")
        for name in names
        for first in range(0, protocol.episodes, protocol.num_envs)
        if policy == "agent" or read.get(name) is None
    ]

    def go_on() -> None:
        work.check()
        if stop is not None and stop():
            raise EvaluationStopped

    settings = Playing(protocol.seed, protocol.epsilon, protocol.max_episode_steps, note, go_on)

    def played(group: tuple[str, int, range]) -> list[EpisodeScore]:
        policy, task, numbers = group
        if policy == "random":
            return play_episodes(policy, None, suite, task, numbers, replace(settings, epsilon=1.0))
        own = agent.independent()
        return play_episodes(
            policy, own.q_values, suite, task, numbers, replace(settings, reseed=own.reseed if own.draws else None)
        )

    with parts(in_threads=suite.thread_safe) as work:
        now = [episode for group in work.map(played, groups) for episode in group]
    of = {
        (policy, name): [e for e in (*now, *known) if (e.policy, e.task) == (policy, name)]
        for policy in ("agent", "random")
        for name in names
    }
    if random_play is not None:
        for name in names:
            if read[name] is None:
                random_play.keep(name, of["random", name])
    rows = [summarize(suite, episodes) for episodes in of.values()]
    return Evaluation(protocol, agent.step, tuple(rows), tuple(e for episodes in of.values() for e in episodes))


@dataclass(frozen=True)
class Playing:
    """How episodes are played.

    Attributes:
        seed: root of the episodes' seeds.
        epsilon: share of random actions.
        max_episode_steps: longer episodes are cut off.
        note: receives what the user should know.
        go_on: called before every step; what it raises ends the play.
        reseed: of decisions that draw random numbers. They are then drawn anew from an episode's seed for each of its
            decisions, so that an episode does not depend on those beside it; one decision is made after the other.
    """

    seed: int
    epsilon: float
    max_episode_steps: int = EvaluationConfig.max_episode_steps
    note: Callable[[str], None] | None = None
    go_on: Callable[[], None] | None = None
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
    play = Play(suite, task, len(numbers))
    try:
        return sorted(_played(policy, q_function, suite, play, numbers, playing), key=lambda e: e.episode)
    finally:
        play.close()


def _played(
    policy: str,
    q_function: QFunction | None,
    suite: TaskSuite,
    play: Play,
    numbers: Sequence[int],
    playing: Playing,
) -> Iterator[EpisodeScore]:
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
        if q_function is not None:
            asked = np.flatnonzero(running)
            drawn = [(playing.seed, task, int(numbers[int(env)]), int(play.lengths_steps[env])) for env in asked]
            q_nA = _decided(q_function, play.observations[asked], task, drawn, playing.reseed)
            q_sums[asked] += q_nA.max(axis=1)
            actions[asked] = np.where(explore[asked], actions[asked], q_nA.argmax(axis=1))
        played = play.step(actions)
        _announce(policy, suite.names[task], play.lengths_steps[running], playing)
        cut = running & (play.lengths_steps >= playing.max_episode_steps)
        for env in np.union1d(played.ended, np.flatnonzero(cut)):
            if running[env]:
                length = int(play.lengths_steps[env])
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
    """Say that an episode is long, once for the episodes that are played side by side."""
    long = min(LONG_EPISODE_STEPS, playing.max_episode_steps)
    if playing.note is not None and lengths_steps.max() == long:
        rest = f"it is cut off after {playing.max_episode_steps:,} (evaluation.max_episode_steps)"
        if long == playing.max_episode_steps:
            rest = "it is cut off here (evaluation.max_episode_steps), with the return that it has"
        playing.note(f"{task}: an episode of the {policy} policy has not ended after {long:,} steps; {rest}")


def summarize(suite: TaskSuite, episodes: list[EpisodeScore]) -> TaskScore:
    """Mean, median, standard error and human-normalised mean of one policy's episodes of one task."""
    scores = np.asarray([episode.score for episode in episodes])
    name = episodes[0].task
    reference = suite.references.get(name)
    mean = float(scores.mean())
    q = [episode.mean_q for episode in episodes if episode.mean_q is not None]
    return TaskScore(
        policy=episodes[0].policy,
        task=name,
        episodes=len(scores),
        mean=mean,
        median=float(np.median(scores)),
        standard_error=float(scores.std(ddof=1)) / math.sqrt(len(scores)) if len(scores) > 1 else None,
        human_normalized=reference.normalized(mean) if reference else None,
        mean_length_steps=float(np.mean([episode.length_steps for episode in episodes])),
        mean_q=float(np.mean(q)) if q else None,
    )
