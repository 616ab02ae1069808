"""Evaluation: episodes of each task under a stated protocol, raw scores, and what they mean beside known scores."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from switchmt_snn.config import EvaluationConfig, TasksConfig
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.suite import TaskSuite

QFunction = Callable[[npt.NDArray[Any], int], npt.NDArray[np.float32]]
"""Stacked observations ``[n, ...]`` and a task -> Q-values ``[n, A]``, -inf where an action does not exist."""


class DecisionMaker(Protocol):
    """What an evaluation needs of an agent: the trained network is one, an exported file another."""

    suite: TaskSuite
    step: int

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of a random encoding."""

    def q_values(self, observation: npt.NDArray[Any], task: int) -> npt.NDArray[np.float32]:
        """Q-values ``[B, A]`` of stacked observations ``[B, ...]``, -inf where an action does not exist."""


@dataclass(frozen=True)
class EvaluationProtocol:
    """Everything that a score depends on besides the agent; printed beside every score."""

    episodes: int
    epsilon: float
    seed: int
    num_envs: int
    suite: str
    sticky_action_probability: float
    fire_on_reset: bool
    noop_max: int
    frame_skip: int
    max_episode_frames: int
    score: str = "raw return, unclipped"

    @classmethod
    def of(cls, evaluation: EvaluationConfig, tasks: TasksConfig) -> EvaluationProtocol:
        """The protocol that a config describes."""
        return cls(
            episodes=evaluation.episodes,
            epsilon=evaluation.epsilon,
            seed=evaluation.seed,
            num_envs=min(evaluation.num_envs, evaluation.episodes),
            suite=tasks.suite,
            sticky_action_probability=tasks.sticky_action_probability,
            fire_on_reset=tasks.fire_on_reset,
            noop_max=tasks.noop_max,
            frame_skip=tasks.frame_skip,
            max_episode_frames=tasks.max_episode_frames,
        )

    def __str__(self) -> str:
        parts = [f"{self.episodes} episodes per task", f"epsilon {self.epsilon:g}", self.score, f"seed {self.seed}"]
        if self.suite == "gym":
            return ", ".join(parts)
        parts.append(f"sticky actions {self.sticky_action_probability:g}")
        if self.suite == "atari":
            fire = "on" if self.fire_on_reset else "off"
            parts += [f"fire on reset {fire}", f"no-ops <= {self.noop_max}", f"frame skip {self.frame_skip}"]
        return ", ".join([*parts, f"frame cap {self.max_episode_frames:,}"])


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
    agent: DecisionMaker, protocol: EvaluationProtocol, tasks: tuple[str, ...] | None = None
) -> Evaluation:
    """Play ``protocol.episodes`` episodes of each task with the agent and with the random policy.

    Deterministic for a protocol: an episode's environment and its random actions come from (seed, task, episode).

    Raises:
        TaskError: a task is not one of the agent's.
    """
    suite = agent.suite
    names = tasks or suite.names
    episodes: list[EpisodeScore] = []
    for name in names:
        task = suite.index(name)
        agent.reseed(protocol.seed)
        episodes += play_episodes("agent", agent.q_values, suite, task, protocol, protocol.epsilon)
        episodes += play_episodes("random", None, suite, task, protocol, 1.0)
    rows = []
    for policy in ("agent", "random"):
        for name in names:
            rows.append(summarize(suite, [e for e in episodes if e.policy == policy and e.task == name]))
    return Evaluation(protocol, agent.step, tuple(rows), tuple(episodes))


def play_episodes(
    policy: str, q_function: QFunction | None, suite: TaskSuite, task: int, protocol: EvaluationProtocol, epsilon: float
) -> list[EpisodeScore]:
    """Play episodes side by side with epsilon-greedy actions; ``q_function`` None plays at random."""
    play = Play(suite, task, protocol.num_envs)
    try:
        return sorted(_played(policy, q_function, suite, play, protocol, epsilon), key=lambda score: score.episode)
    finally:
        play.close()


def _played(
    policy: str,
    q_function: QFunction | None,
    suite: TaskSuite,
    play: Play,
    protocol: EvaluationProtocol,
    epsilon: float,
) -> Iterator[EpisodeScore]:
    n, task = play.num_envs, play.task
    valid = np.flatnonzero(suite.valid_actions_KA[task])
    waiting = iter(range(n, protocol.episodes))
    running: list[int | None] = list(range(n))
    rngs = [np.random.default_rng([protocol.seed, task, episode]) for episode in range(n)]
    q_sums = np.zeros(n)
    seeds = np.asarray([episode_seed(protocol.seed, task, episode) for episode in range(n)], np.int64)
    play.begin(np.arange(n), seeds)
    while any(episode is not None for episode in running):
        explore = np.asarray([rng.random() < epsilon for rng in rngs])
        actions = np.asarray([valid[rng.integers(len(valid))] for rng in rngs], np.int64)
        if q_function is not None:
            q_nA = q_function(play.observations, task)
            q_sums += q_nA.max(axis=1)
            actions = np.where(explore, actions, q_nA.argmax(axis=1))
        played = play.step(actions)
        for env in played.ended:
            episode = running[env]
            if episode is not None:
                length = int(play.lengths_steps[env])
                yield EpisodeScore(
                    policy=policy,
                    task=suite.names[task],
                    episode=episode,
                    seed=int(seeds[env]),
                    score=float(play.returns[env]),
                    length_steps=length,
                    mean_q=None if q_function is None else float(q_sums[env]) / length,
                    truncated=bool(played.truncated[env]) and not bool(played.terminated[env]),
                )
            running[env] = next(waiting, None)
            if (following := running[env]) is not None:
                seeds[env] = episode_seed(protocol.seed, task, following)
                rngs[env] = np.random.default_rng([protocol.seed, task, following])
            # An idle copy starts its last episode again, unobserved: environments must not be stepped past an end.
            play.begin(np.asarray([env]), seeds[env : env + 1])
            q_sums[env] = 0.0


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
        human_normalized=(mean - reference.random) / (reference.human - reference.random) if reference else None,
        mean_length_steps=float(np.mean([episode.length_steps for episode in episodes])),
        mean_q=float(np.mean(q)) if q else None,
    )
