"""Recorded play: observations that a trained agent really sees, kept in the run folder for parity and profiling."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.acting.agent import Agent
from switchmt_snn.errors import ExportError
from switchmt_snn.export.npz import read_npz
from switchmt_snn.machine.cores import parts
from switchmt_snn.machine.progress import progress_of
from switchmt_snn.runs.files import file_name, made, written_whole
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.suite import TaskSuite

COPIES = 4
"""Copies of a task that are recorded side by side; each gives a contiguous stretch."""
_KEYS = ("observations", "actions", "epsilon", "seed")
"""Arrays that every file has."""
PIECE_STEPS = 64
"""Steps of every copy that are held at once where play is not kept."""


@dataclass(frozen=True)
class Recording:
    """Decisions of one task, in order of play, one copy of the task after the other.

    Attributes:
        observations: raw stacked observations ``[N, *shape]``.
        actions: what was done ``[N]``, as indices of Q-values.
        rewards: raw reward of each action ``[N]``; None in files of older versions.
        epsilon: share of random actions while it was recorded.
        seed: of the episodes.

    The file also has ``first_action``, which the environment adds to every action (0 for most).
    """

    task: str
    observations: npt.NDArray[Any]
    actions: npt.NDArray[np.int64]
    rewards: npt.NDArray[np.float64] | None
    epsilon: float
    seed: int


def recorded_plays(agent: Agent, folder: Path, decisions: int) -> Iterator[Recording]:
    """``recorded_play`` of every task in turn; while one is used, the next are being played."""

    def one(task: str) -> Recording:
        return recorded_play(agent.independent(), folder, task, decisions, go_on)

    def go_on() -> None:
        work.check()
        progress.advance(COPIES)

    names = agent.suite.names
    with (
        progress_of(f"recording {', '.join(names)}", len(names) * decisions, "decisions") as progress,
        parts(in_threads=agent.suite.thread_safe) as work,
    ):
        yield from work.map(one, names)


def recorded_play(
    agent: Agent, folder: Path, task: str, decisions: int, go_on: Callable[[], None] | None = None
) -> Recording:
    """``decisions`` recorded decisions of a task, rounded up to whole steps of all copies.

    Read if ``folder`` has as many, else played and stored; the same ones either way. Played like an evaluation: greedy
    with the run's evaluation epsilon and seed. Tasks with code from outside are always played: nothing tells whether it
    has changed (``TaskSuite.versioned``). ``go_on`` is called before every step; what it raises ends the play.
    """
    config = agent.config.evaluation
    path = folder / f"{file_name(task)}-step-{agent.step}.npz"
    if path.exists():
        recording = read_recording(path, task, agent.suite)
        stale = recording.rewards is None or recording.seed != config.seed or not agent.suite.versioned
        if len(recording.actions) >= decisions and not stale:
            return _first(recording, decisions)
    recording = play(agent, task, decisions, config.epsilon, config.seed, go_on)
    made(folder)
    with written_whole(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(
            stream,
            observations=recording.observations,
            actions=recording.actions,
            rewards=np.asarray(recording.rewards, np.float64),
            first_action=np.asarray(agent.suite.first_action(agent.suite.index(task))),
            epsilon=np.asarray(recording.epsilon),
            seed=np.asarray(recording.seed),
        )
    return recording


def _first(recording: Recording, decisions: int) -> Recording:
    """The first decisions of every copy: what a recording of that many would have been."""
    steps = -(-decisions // COPIES)

    def first(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return values.reshape(COPIES, -1, *values.shape[1:])[:, :steps].reshape(-1, *values.shape[1:])

    rewards = None if recording.rewards is None else first(recording.rewards)
    observations = np.ascontiguousarray(first(recording.observations))
    return replace(recording, observations=observations, actions=first(recording.actions), rewards=rewards)


def read_recording(path: Path, task: str, suite: TaskSuite) -> Recording:
    """Recorded play from a file.

    Raises:
        ExportError: it is none of this task.
    """
    stored = read_npz(path, (*_KEYS, "rewards"), "recorded play of this run; delete it")
    for key in _KEYS:
        if key not in stored:
            raise ExportError(f"recorded play {path} has no {key}, expected {', '.join(_KEYS)}; delete it")
    observations, actions = stored["observations"], stored["actions"]
    whole = actions.ndim == 1 and actions.dtype.kind in "iu"
    expected = (len(actions) if whole else "N", *suite.observation_shape)
    if not whole or observations.shape != expected or observations.dtype != suite.frame_dtype or len(actions) % COPIES:
        raise ExportError(
            f"recorded play {path} has observations of shape {observations.shape} and type {observations.dtype}, and "
            f"actions of shape {actions.shape} and type {actions.dtype}, expected {expected} of "
            f"{np.dtype(suite.frame_dtype)} and whole numbers, a multiple of {COPIES}; delete it"
        )
    valid = np.flatnonzero(suite.valid_actions_KA[suite.index(task)])
    strange = actions[~np.isin(actions, valid)]
    if len(strange):
        raise ExportError(
            f"recorded play {path} has the action {strange[0]}, expected one of {valid.tolist()}, which {task} has; "
            "delete it"
        )
    epsilon, seed = stored["epsilon"], stored["seed"]
    if epsilon.shape != () or not 0 <= epsilon <= 1 or seed.shape != () or seed.dtype.kind not in "iu" or seed < 0:
        raise ExportError(
            f"recorded play {path} has epsilon {epsilon.tolist()!r:.40} and seed {seed.tolist()!r:.40}, expected a "
            "probability and a whole number from 0; delete it"
        )
    rewards = stored.get("rewards")
    if rewards is not None and (rewards.shape != actions.shape or rewards.dtype.kind != "f"):
        raise ExportError(
            f"recorded play {path} has rewards of shape {rewards.shape} and type {rewards.dtype}, expected "
            f"{actions.shape} of floating-point numbers; delete it"
        )
    return Recording(task, observations, actions.astype(np.int64), rewards, float(epsilon), int(seed))


def play(
    agent: Agent, task: str, decisions: int, epsilon: float, seed: int, go_on: Callable[[], None] | None = None
) -> Recording:
    """Play at least ``decisions`` decisions of a task in ``COPIES`` copies."""
    pieces = list(play_in_pieces(agent, task, decisions, epsilon, seed, go_on))
    observations, actions, rewards = (np.concatenate(parts, axis=1) for parts in zip(*pieces, strict=True))
    flat = observations.reshape(-1, *agent.suite.observation_shape)
    return Recording(task, flat, actions.reshape(-1), rewards.reshape(-1), epsilon, seed)


def play_in_pieces(
    agent: Agent, task: str, decisions: int, epsilon: float, seed: int, go_on: Callable[[], None] | None = None
) -> Iterator[tuple[npt.NDArray[Any], npt.NDArray[np.int64], npt.NDArray[np.float64]]]:
    """``play`` piece by piece: observations ``[COPIES, n, *shape]``, actions and rewards ``[COPIES, n]``."""
    index, suite = agent.suite.index(task), agent.suite
    rng = np.random.default_rng([seed, index])
    valid = np.flatnonzero(suite.valid_actions_KA[index])
    agent.reseed(seed)
    copies = Play(suite, index, COPIES)
    episodes, left = 0, -(-decisions // COPIES)
    try:
        while left:
            steps = min(left, PIECE_STEPS)
            observations = np.empty((COPIES, steps, *suite.observation_shape), suite.frame_dtype)
            actions, rewards = np.empty((COPIES, steps), np.int64), np.empty((COPIES, steps))
            for step in range(steps):
                if go_on is not None:
                    go_on()
                over = np.flatnonzero(copies.over)
                if len(over):
                    copies.begin(over, np.asarray([episode_seed(seed, index, episodes + i) for i in range(len(over))]))
                    episodes += len(over)
                explore = rng.random(COPIES) < epsilon
                random_actions = valid[rng.integers(0, len(valid), COPIES)]
                observations[:, step] = copies.observations
                actions[:, step] = np.where(
                    explore, random_actions, agent.q_values(copies.observations, index).argmax(axis=-1)
                )
                rewards[:, step] = copies.step(actions[:, step]).rewards
            yield observations, actions, rewards
            left -= steps
    finally:
        copies.close()
