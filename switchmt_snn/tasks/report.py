"""What a task is taken for, and how it plays: ``check_env``, as ``switchmt-snn check-env`` prints it."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from switchmt_snn.config import TasksConfig
from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.check import FROM_ITS_SEED, differs_from, journal, one_episode
from switchmt_snn.tasks.gym_copies import GymCopies
from switchmt_snn.tasks.gym_make import make_environment
from switchmt_snn.tasks.gym_spaces import RoundedObservation, dim_pixels, frame_layout, rounding
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.registry import make_suite, suite_of
from switchmt_snn.tasks.suite import TaskEnvironment, TaskSuite

COMPARED_STEPS = 200
"""Steps that are played again to compare them."""
THREADS = 4
"""Threads that play at a time for the check of thread safety."""
LONGEST_S = 30.0
"""Default limit of a task's check: half of it for the random play, the other half for playing again."""
SAID_EVERY_S = 5.0
SLOW_STEPS_PER_S = 200
"""A slower environment takes longer than its training does."""
PLAYS_AGAIN = 2 * (4 + THREADS)
"""Plays of as many steps as are compared: of two copies, alone and in threads, and the starts of episodes."""


@dataclass(frozen=True)
class EnvironmentReport:
    """One task: what it is taken for, and what a random play of one copy showed.

    Attributes:
        task: its name.
        suite: value of ``tasks.suite``.
        observes: the observation space, as Gymnasium prints it; None outside the gym suite.
        frame_shape: of one frame of this task in the suite, channels first.
        frame_dtype: ``uint8`` or ``float32``.
        layout: ``vector``, or where the channels of the environment's images are.
        scale: factor to the network's input.
        observed: smallest and largest raw value.
        actions: by the environment's own numbers.
        steps: of the random play, that were really played.
        ended_by_limit_s: the limit of time that ended the random play before its steps; None if none did.
        compared_steps: that were played again for ``repeats``, ``seeds_differ`` and ``same_in_threads``.
        episode_lengths: of episodes that ended.
        episode_returns: likewise.
        truncated: how many of them were truncated.
        rewards: smallest and largest.
        limit_steps: longest episode that the environment allows; None if it says none.
        repeats: whether the same seed and actions give the same play in an environment made anew.
        starts_afresh: whether an episode is the same after other episodes as in an environment made anew.
        seeds_differ: whether another seed gives another play.
        draws_globally: whether it draws from (or seeds) the generators of ``random``, ``numpy.random`` or torch.
        played_in_threads: whether evaluations play it in several threads at a time.
        same_in_threads: whether several threads at a time play what one plays.
        steps_per_s: of one copy, with random actions.
        notes: what its author should know.
    """

    task: str
    suite: str
    observes: str | None
    frame_shape: tuple[int, ...]
    frame_dtype: str
    layout: str
    scale: float
    observed: tuple[float, float]
    actions: tuple[int, ...]
    steps: int
    ended_by_limit_s: float | None
    compared_steps: int
    episode_lengths: tuple[int, ...]
    episode_returns: tuple[float, ...]
    truncated: int
    rewards: tuple[float, float]
    limit_steps: int | None
    repeats: bool
    starts_afresh: bool
    seeds_differ: bool
    draws_globally: bool
    played_in_threads: bool
    same_in_threads: bool
    steps_per_s: float
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def _nothing(_text: str) -> None:
    """Say nothing."""


@dataclass(frozen=True)
class _Asked:
    """How a task is to be played; see ``check_env``."""

    steps: int
    seconds: float
    seed: int
    say: Callable[[str], None]
    clock: Callable[[], float]


def check_env(
    *names: str,
    suite: str = "gym",
    steps: int = 1000,
    seconds: float = LONGEST_S,
    seed: int = 0,
    say: Callable[[str], None] = _nothing,
    clock: Callable[[], float] = time.perf_counter,
    **settings: Any,
) -> tuple[EnvironmentReport, ...]:
    """What tasks are taken for, and how they play; in the manner of Gymnasium's checker, whose warnings are notes here.

    Args:
        names: of the tasks; together they must fit one network.
        suite: value of ``tasks.suite``.
        steps: of random play, with one copy of each task.
        seconds: about how long the check of one task may take. Half of it is the limit of the random play, which stops
            there; as many steps are played again as fit the other half (at least one, at most 200).
        seed: of episodes and random actions.
        say: is told in plain lines what is being done.
        clock: the time in seconds, from any start.
        settings: other fields of ``TasksConfig`` (``wrappers``, ``image_layout``, ...).

    Raises:
        ConfigError: no such suite or setting.
        TaskError: training would refuse a task; names it, what was seen, and what to do.

    Examples:
        >>> (report,) = check_env("CartPole-v1", steps=300)
        >>> report.layout, report.frame_shape, report.actions, report.limit_steps, report.repeats
        ('vector', (4,), (0, 1), 500, True)
    """
    config = TasksConfig(suite=suite, names=names, **settings)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tasks = make_suite(config)
        asked = _Asked(steps, seconds, seed, say, clock)
        reports = [_report(config, tasks, task, asked) for task in range(len(names))]
    # A DeprecationWarning is for a library's authors; Python, too, hides it from those who run the library.
    told = (warning for warning in caught if not issubclass(warning.category, (DeprecationWarning, RoundedObservation)))
    heard = tuple(dict.fromkeys(_plain(str(warning.message)) for warning in told))
    if heard and len(reports) == 1:
        reports[0] = replace(reports[0], notes=(*reports[0].notes, *heard))
    return tuple(reports)


def _report(config: TasksConfig, tasks: TaskSuite, task: int, asked: _Asked) -> EnvironmentReport:
    seed = asked.seed
    made: list[TaskEnvironment] = []

    def make(number: int, num_envs: int) -> TaskEnvironment:
        made.append(tasks.make(number, num_envs))
        return made[-1]

    played = _Played(replace(tasks, make=make), task, asked)
    fitting = asked.seconds / 2 * played.steps_per_s / PLAYS_AGAIN
    compared = max(1, int(min(asked.steps, COMPARED_STEPS, fitting)))
    asked.say(
        f"{tasks.names[task]}: plays {compared:,} steps again, with the same seed, with another one, and in {THREADS} "
        "threads"
    )
    played.compare_start(tasks, compared)
    first = journal(tasks, task, compared, seed)
    facts = _gym_facts(config, task)
    actions = np.flatnonzero(tasks.valid_actions_KA[task]) + tasks.first_action(task)
    report = EnvironmentReport(
        task=tasks.names[task],
        suite=suite_of(config).name,
        observes=facts["observes"],
        frame_shape=tasks.frame_shape,
        frame_dtype=np.dtype(tasks.frame_dtype).name,
        layout=facts["layout"] or ("vector" if len(tasks.frame_shape) == 1 else "channels_first"),
        scale=tasks.scale,
        observed=(played.low, played.high),
        actions=tuple(actions.tolist()),
        steps=len(played.rewards),
        ended_by_limit_s=asked.seconds / 2 if len(played.rewards) < asked.steps else None,
        compared_steps=compared,
        episode_lengths=tuple(played.lengths),
        episode_returns=tuple(played.returns),
        truncated=played.truncated,
        rewards=(min(played.rewards), max(played.rewards)),
        limit_steps=facts["limit_steps"],
        repeats=differs_from(first, journal(tasks, task, compared, seed)) is None,
        starts_afresh=played.starts_afresh,
        seeds_differ=differs_from(first, journal(tasks, task, compared, seed + 1, actions_seed=seed)) is not None,
        draws_globally=isinstance(made[0], GymCopies) and made[0].draws_globally,
        played_in_threads=tasks.thread_safe,
        same_in_threads=_same_in_threads(tasks, task, compared, seed, first),
        steps_per_s=played.steps_per_s,
    )
    return replace(report, notes=tuple(_notes(report, facts["space"], suite_of(config).defaults.clip_rewards)))


class _Played:
    """A random play of one copy, until its steps or its time are over."""

    def __init__(self, tasks: TaskSuite, task: int, asked: _Asked) -> None:
        self._task, self._seed, self._valid = task, asked.seed, np.flatnonzero(tasks.valid_actions_KA[task])
        self.lengths: list[int] = []
        self.returns: list[float] = []
        self.rewards: list[float] = []
        self.truncated = 0
        self._play = Play(tasks, task, 1)
        try:
            self._play_at_random(tasks.names[task], asked)
        except BaseException:
            self._play.close()
            raise

    def _play_at_random(self, name: str, asked: _Asked) -> None:
        rng, one, episodes, play = np.random.default_rng(asked.seed), np.zeros(1, np.int64), 1, self._play
        limit_s = asked.seconds / 2
        asked.say(f"{name}: random play of {asked.steps:,} steps, for {limit_s:g} s at the most")
        frames = play.begin(one, np.asarray([episode_seed(asked.seed, self._task, 0)]))
        self.low, self.high = float(frames.min()), float(frames.max())
        started = asked.clock()
        said = 0.0
        for step in range(1, asked.steps + 1):
            result = play.step(rng.choice(self._valid, 1))
            self.low = min(self.low, float(result.frames.min()))
            self.high = max(self.high, float(result.frames.max()))
            self.rewards.append(float(result.rewards[0]))
            if len(result.ended):
                self.lengths.append(int(play.lengths_steps[0]))
                self.returns.append(float(play.returns[0]))
                self.truncated += bool(result.truncated[0]) and not bool(result.terminated[0])
                play.begin(one, np.asarray([episode_seed(asked.seed, self._task, episodes)]))
                episodes += 1
            elapsed = asked.clock() - started
            if elapsed >= limit_s:
                break
            if elapsed - said >= SAID_EVERY_S:
                said = elapsed
                asked.say(f"{name}: {step:,} of {asked.steps:,} steps in {elapsed:.0f} s")
        self.steps_per_s = len(self.rewards) / max(asked.clock() - started, 1e-9)

    def compare_start(self, tasks: TaskSuite, steps: int) -> None:
        """Whether an episode's first steps, after those played, are as in an environment made anew; closes the play."""
        try:
            steps = min(steps, COMPARED_STEPS // 4)
            again = one_episode(self._play, self._valid, self._seed, steps)
        finally:
            self._play.close()
        anew = Play(tasks, self._task, 1)
        try:
            self.starts_afresh = differs_from(again, one_episode(anew, self._valid, self._seed, steps)) is None
        finally:
            anew.close()


def _same_in_threads(tasks: TaskSuite, task: int, steps: int, seed: int, expected: Any) -> bool:
    try:
        with ThreadPoolExecutor(THREADS) as pool:
            plays = list(pool.map(lambda _: journal(tasks, task, steps, seed), range(THREADS)))
    except TaskError:
        return False  # alone it has just played without an error
    return all(differs_from(expected, play) is None for play in plays)


def _gym_facts(config: TasksConfig, task: int) -> dict[str, Any]:
    """What only a Gymnasium environment says of itself."""
    if config.suite != "gym":
        return {"observes": None, "layout": None, "limit_steps": None, "space": None}
    env = make_environment(config.names[task], config.wrappers)
    space = env.observation_space
    layout = frame_layout(config.names[task], space, config.image_layout)
    facts = {
        "observes": " ".join(str(space).split()),
        "layout": layout.kind,
        "limit_steps": None if env.spec is None else env.spec.max_episode_steps,
        "space": space,
    }
    env.close()
    return facts


def _notes(report: EnvironmentReport, space: Box | None, clips: bool) -> list[str]:
    notes = []
    if not report.repeats:
        notes.append(
            "the same seed and actions do not give the same play: scores differ from one evaluation to the next, and a "
            f"resumed run is not exact; {FROM_ITS_SEED}"
        )
    elif not report.starts_afresh:
        notes.append(
            "an episode depends on the episodes before it: scores depend on the number of copies, and a resumed run is "
            f"not exact; {FROM_ITS_SEED}"
        )
    if report.steps_per_s < SLOW_STEPS_PER_S:
        hours = 100_000 / report.steps_per_s / 3600
        remedy = "; tasks.subprocesses=true plays its copies at the same time" if report.suite == "gym" else ""
        notes.append(f"{report.steps_per_s:.3g} steps/s: 100,000 steps of one copy take {hours:,.1f} hours{remedy}")
    if report.draws_globally:
        notes.append("it draws from the global generators; here they are seeded by the episode's seed")
    if not report.seeds_differ:
        notes.append("every seed gives the same play: episodes of an evaluation differ by random actions only")
    if report.repeats and not report.same_in_threads:
        notes.append("copies share state: several threads at a time play something else than one")
    if not report.episode_lengths:
        limit = "has no limit" if report.limit_steps is None else f"ends after {report.limit_steps:,} at the latest"
        notes.append(
            f"no episode ended in {report.steps:,} steps, and the environment {limit} (max_episode_steps); evaluations "
            "cut episodes off after evaluation.max_episode_steps"
        )
    notes += _notes_on_values(report, space)
    largest = max(-report.rewards[0], report.rewards[1])
    if largest > 1:
        default = f"learning.clip_rewards ({str(clips).lower()} by default in the suite {report.suite})"
        effect = "clips them to [-1, 1]" if clips else "leaves them; a Huber loss or smaller rewards help"
        notes.append(f"rewards up to {largest:g}: {default} {effect}")
    return notes


def _notes_on_values(report: EnvironmentReport, space: Box | None) -> list[str]:
    notes = []
    low, high = report.observed
    if space is not None:
        lowest, highest = float(np.min(space.low)), float(np.max(space.high))
        if not (lowest <= low and high <= highest):
            notes.append(
                f"observations from {low:g} to {high:g} leave the space's bounds from {lowest:g} to {highest:g}"
            )
    rounded = None if space is None else rounding(space, max(-low, high))
    dim = dim_pixels(report.scale, high)
    if dim is not None:
        notes.append(dim)
    if rounded is not None:
        notes.append(rounded)
    elif report.layout == "vector" and max(-low, high) > 100:
        notes.append(f"values up to {max(-low, high):g} reach the network as they are; scale them in a wrapper")
    return notes


def _plain(text: str) -> str:
    """A warning of Gymnasium without colours and its prefix, on one line."""
    return " ".join(re.sub(r"\x1b\[\d*m", "", text).removeprefix("WARN: ").split())
