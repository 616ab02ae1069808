"""Evaluation: episodes of each task under a stated protocol, raw scores, and scores relative to known ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from switchmt_snn.acting.episodes import EpisodeScore, Playing, play_episodes
from switchmt_snn.config import EvaluationConfig, TasksConfig
from switchmt_snn.config.numbers import exact
from switchmt_snn.config.plugins import is_plugin
from switchmt_snn.errors import ConfigError
from switchmt_snn.machine.cores import parts
from switchmt_snn.machine.progress import progress_of
from switchmt_snn.tasks.changing import changed_conditions
from switchmt_snn.tasks.registry import suite_of
from switchmt_snn.tasks.suite import TaskSuite


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
        environment: the suite's conditions of play in words, as ``sticky actions 0.25``, and what tasks have become
            (``tasks.later_names``).
        score: what is summed.
        statistics_batches: the normalisation statistics were re-estimated from so many batches of each task's
            replay; 0: they are those stored with the weights.
    """

    episodes: int
    epsilon: float
    seed: int
    num_envs: int
    suite: str
    environment: tuple[str, ...] = ()
    score: str = "raw return, unclipped"
    max_episode_steps: int = EvaluationConfig.max_episode_steps
    statistics_batches: int = 0

    @classmethod
    def of(cls, evaluation: EvaluationConfig, tasks: TasksConfig, step: int = 0) -> EvaluationProtocol:
        """The protocol that a config describes, for weights of ``step``."""
        return cls(
            episodes=evaluation.episodes,
            epsilon=evaluation.epsilon,
            seed=evaluation.seed,
            num_envs=min(evaluation.num_envs, evaluation.episodes),
            suite=tasks.suite,
            max_episode_steps=evaluation.max_episode_steps,
            environment=(*suite_of(tasks).protocol, *changed_conditions(tasks, step)),
        )

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> EvaluationProtocol:
        """The protocol in a stored evaluation; before version 0.2, every file had the settings of Atari as fields."""
        own = {field.name: stored[field.name] for field in fields(cls) if field.name in stored}
        if "environment" in stored:
            return cls(**{**own, "environment": tuple(stored["environment"])})
        settings = {field.name: stored[field.name] for field in fields(TasksConfig) if field.name in stored}
        if is_plugin(settings.get("suite")):
            raise ConfigError("the protocol has no environment, expected one: its suite is from outside the package")
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
        if self.statistics_batches:
            played.append(f"normalisation statistics re-estimated from {self.statistics_batches} batches")
        return ", ".join([*played, *self.environment])


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


def once(note: Callable[[str], None] | None) -> Callable[[str], None] | None:
    """What passes each text on to ``note`` once."""
    said: set[str] = set()

    def say(text: str) -> None:
        if note is not None and text not in said:
            said.add(text)
            note(text)

    return None if note is None else say


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
        note: receives what the user should know meanwhile, each line once: episodes that do not end.
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

    settings = Playing(
        protocol.seed, protocol.epsilon, protocol.max_episode_steps, once(note), go_on, lambda: progress.advance()
    )

    def played(group: tuple[str, int, range]) -> list[EpisodeScore]:
        policy, task, numbers = group
        if policy == "random":
            return play_episodes(policy, None, suite, task, numbers, replace(settings, epsilon=1.0))
        own = agent.independent()
        return play_episodes(
            policy, own.q_values, suite, task, numbers, replace(settings, reseed=own.reseed if own.draws else None)
        )

    what, total = f"playing {', '.join(names)}", sum(len(numbers) for *_, numbers in groups)
    with progress_of(what, total, "episodes") as progress, parts(in_threads=suite.thread_safe) as work:
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
