"""Switching policies: at each episode end, stay on the task or go to the next one (paper, section 3.2.2, Algorithm 1).

A policy is a criterion (has learning on this task levelled off?) inside the bounds that all policies share
(``min_stay_*``, ``max_stay_steps``). The next task is always ``(i + 1) mod |E|``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.state import Stateful


@dataclass(frozen=True)
class EpisodeRecord:
    """What a policy may look at when an episode ends.

    Attributes:
        task: index of the task.
        episodes_in_visit: episodes ended since the task was entered, this one included.
        steps_in_visit: agent steps since the task was entered.
        updates: gradient steps of the whole run.
        episode_return: raw return of the episode.
        parameters: called, gives theta_t as a vector of its own (a copy).
    """

    task: int
    episodes_in_visit: int
    steps_in_visit: int
    updates: int
    episode_return: float
    parameters: Callable[[], Tensor]


@dataclass(frozen=True)
class Verdict:
    """A criterion's answer, with every number that it used."""

    leave: bool
    reason: str
    measured: dict[str, float]


@dataclass(frozen=True)
class Stay:
    """Stay on the task."""

    reason: str
    measured: dict[str, float]


@dataclass(frozen=True)
class SwitchTo:
    """Leave for another task."""

    task: int
    reason: str
    measured: dict[str, float]


class Criterion(Protocol):
    """Decides whether learning on the current task has levelled off."""

    def start_visit(self) -> None:
        """Forget the last visit (Algorithm 1: H_i <- [])."""

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Take in an episode and judge."""


class FixedEpisodes(Stateful):
    """Leave after a number of episodes (MTSpark and the baselines: 25)."""

    DERIVED = ("episodes",)

    def __init__(self, config: SwitchingConfig) -> None:
        self.episodes = config.visit_episodes

    def start_visit(self) -> None:
        """Nothing to forget."""

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Count episodes."""
        measured = {"episodes_in_visit": float(record.episodes_in_visit), "visit_episodes": float(self.episodes)}
        return Verdict(record.episodes_in_visit >= self.episodes, "visit_episodes", measured)


class FixedSteps(Stateful):
    """Leave at the first episode end after a number of steps."""

    DERIVED = ("steps",)

    def __init__(self, config: SwitchingConfig) -> None:
        self.steps = config.visit_steps

    def start_visit(self) -> None:
        """Nothing to forget."""

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Count steps."""
        measured = {"steps_in_visit": float(record.steps_in_visit), "visit_steps": float(self.steps)}
        return Verdict(record.steps_in_visit >= self.steps, "visit_steps", measured)


class Interleave(Stateful):
    """Leave after every episode: the tasks take turns."""

    def __init__(self, config: SwitchingConfig) -> None:
        pass

    def start_visit(self) -> None:
        """Nothing to forget."""

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Leave."""
        return Verdict(True, "interleave", {})


class ParameterChange(Stateful):
    """Eq. 3: leave when ``||theta_t - theta_(t-K)||_2 / ||theta_(t-K)||_2`` falls below the threshold (10 %).

    H holds K + 1 snapshots, so that the change spans K episodes as Eq. 3 says (the listing's K snapshots span K - 1;
    docs/algorithm.md, deviation 2).
    """

    SAVED = ("history",)
    DERIVED = ("window_episodes", "threshold")

    def __init__(self, config: SwitchingConfig) -> None:
        self.window_episodes = config.window_episodes
        self.threshold = config.change_threshold
        self.history: list[Tensor] = []

    def start_visit(self) -> None:
        """H_i <- []."""
        self.history = []

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Append theta_t to H_i; measure the relative change over K episodes."""
        self.history.append(record.parameters())
        measured = {"change_threshold": self.threshold, "snapshots": float(len(self.history))}
        if len(self.history) <= self.window_episodes:
            return Verdict(False, "window_fills", measured)
        del self.history[: len(self.history) - self.window_episodes - 1]
        change = relative_change(self.history[0], self.history[-1])
        measured |= {"parameter_change": change, "snapshots": float(len(self.history))}
        return Verdict(change < self.threshold, "parameter_change", measured)


class ParameterChangePerUpdate(Stateful):
    """Leave when the relative change per gradient step has fallen to a fraction of the visit's largest.

    Eq. 3 grows with the number of updates in K episodes; this one does not know how long episodes are, nor the learning
    rate.
    """

    SAVED = ("history", "updates", "largest")
    DERIVED = ("window_episodes", "fraction")

    def __init__(self, config: SwitchingConfig) -> None:
        self.window_episodes = config.window_episodes
        self.fraction = config.change_rate_fraction
        self.start_visit()

    def start_visit(self) -> None:
        """Forget snapshots and the largest rate."""
        self.history: list[Tensor] = []
        self.updates: list[int] = []
        self.largest = 0.0

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Measure the change per update over K episodes."""
        self.history.append(record.parameters())
        self.updates.append(record.updates)
        if len(self.history) <= self.window_episodes:
            return Verdict(False, "window_fills", {"snapshots": float(len(self.history))})
        del self.history[: len(self.history) - self.window_episodes - 1]
        del self.updates[: len(self.updates) - self.window_episodes - 1]
        change, made = relative_change(self.history[0], self.history[-1]), self.updates[-1] - self.updates[0]
        measured = {"parameter_change": change, "updates_in_window": float(made)}
        if made == 0:
            return Verdict(False, "no_updates_yet", measured)
        rate = change / made
        self.largest = max(self.largest, rate)
        measured |= {"change_per_update": rate, "largest_change_per_update": self.largest}
        measured["change_rate_fraction"] = self.fraction
        return Verdict(rate < self.fraction * self.largest, "change_per_update", measured)


class RewardPlateau(Stateful):
    """Leave when the returns of the visit no longer rise.

    A least-squares line through the newest returns rises if its slope is at least ``plateau_t`` standard errors. Only
    ``plateau_patience_episodes`` episode ends in a row without a rise make a plateau (hysteresis).
    """

    SAVED = ("returns", "flat_episodes")
    DERIVED = ("window_episodes", "t_threshold", "patience_episodes")

    def __init__(self, config: SwitchingConfig) -> None:
        self.window_episodes = config.plateau_window_episodes
        self.t_threshold = config.plateau_t
        self.patience_episodes = config.plateau_patience_episodes
        self.start_visit()

    def start_visit(self) -> None:
        """Forget the returns."""
        self.returns: list[float] = []
        self.flat_episodes = 0

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Test the slope of the newest returns."""
        self.returns = [*self.returns, record.episode_return][-self.window_episodes :]
        if len(self.returns) < self.window_episodes:
            return Verdict(False, "window_fills", {"returns": float(len(self.returns))})
        slope, t = slope_test(self.returns)
        self.flat_episodes = self.flat_episodes + 1 if t < self.t_threshold else 0
        measured = {
            "reward_slope": slope,
            "reward_t": t,
            "plateau_t": self.t_threshold,
            "flat_episodes": float(self.flat_episodes),
        }
        return Verdict(self.flat_episodes >= self.patience_episodes, "reward_plateau", measured)


class ParameterAndReward(Stateful):
    """The abstract's claim: leave when both the parameters and the rewards have levelled off."""

    SAVED = ("parameter", "reward")

    def __init__(self, config: SwitchingConfig) -> None:
        self.parameter = ParameterChange(config)
        self.reward = RewardPlateau(config)

    def start_visit(self) -> None:
        """Forget both."""
        self.parameter.start_visit()
        self.reward.start_visit()

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Ask both criteria."""
        parameter, reward = self.parameter.end_of_episode(record), self.reward.end_of_episode(record)
        measured = parameter.measured | reward.measured
        measured |= {"parameter_says_leave": float(parameter.leave), "reward_says_leave": float(reward.leave)}
        return Verdict(parameter.leave and reward.leave, "parameter_and_reward", measured)


def relative_change(before: Tensor, after: Tensor) -> float:
    """Eq. 3 as a fraction: ``||after - before||_2 / ||before||_2``, summed in float64."""
    before, after = before.to("cpu", torch.float64), after.to("cpu", torch.float64)
    return float(torch.linalg.vector_norm(after - before) / torch.linalg.vector_norm(before))


def slope_test(values: list[float]) -> tuple[float, float]:
    """Least-squares slope per episode and its t statistic (slope over its standard error).

    Returns on an exact line give +-inf, constant ones 0.
    """
    y = np.asarray(values, np.float64)
    x = np.arange(len(y)) - (len(y) - 1) / 2
    spread = float((x * x).sum())
    slope = float((x * y).sum()) / spread
    residual = y - y.mean() - slope * x
    error = math.sqrt(float((residual * residual).sum()) / (len(y) - 2) / spread)
    if error <= 1e-12 * max(1.0, float(np.abs(y).max())):
        return (0.0, 0.0) if math.isclose(slope, 0.0, abs_tol=1e-12) else (slope, math.copysign(math.inf, slope))
    return slope, slope / error


CRITERIA: dict[str, Callable[[SwitchingConfig], Criterion]] = {
    "fixed_episodes": FixedEpisodes,
    "fixed_steps": FixedSteps,
    "interleave": Interleave,
    "parameter_change": ParameterChange,
    "parameter_change_per_update": ParameterChangePerUpdate,
    "reward_plateau": RewardPlateau,
    "parameter_and_reward": ParameterAndReward,
}


class SwitchingPolicy(Stateful):
    """A criterion within the bounds that every policy keeps: never leaves before the minimal stay, always by the
    maximal one."""

    SAVED = ("criterion",)
    DERIVED = ("config", "num_tasks")

    def __init__(self, config: SwitchingConfig, num_tasks: int) -> None:
        """Raises ConfigError if the policy is not resolved or unknown."""
        if config.policy not in CRITERIA:
            raise ConfigError(f"switching.policy is {config.policy!r}, expected one of {', '.join(CRITERIA)}")
        self.config = config
        self.num_tasks = num_tasks
        self.criterion = CRITERIA[config.policy](config)

    def end_of_episode(self, record: EpisodeRecord) -> Stay | SwitchTo:
        """Decide at an episode's end."""
        verdict = self.criterion.end_of_episode(record)
        measured = dict(verdict.measured)
        if self.must_leave(record.steps_in_visit):
            return self._next(record.task, "max_stay_steps", measured)
        if not verdict.leave:
            return Stay(verdict.reason, measured)
        if self.num_tasks == 1:
            return Stay("only_task", measured)
        too_soon = (
            record.steps_in_visit < self.config.min_stay_steps
            or record.episodes_in_visit < self.config.min_stay_episodes
        )
        return Stay("min_stay", measured) if too_soon else self._next(record.task, verdict.reason, measured)

    def must_leave(self, steps_in_visit: int) -> bool:
        """Whether the visit has lasted ``max_stay_steps``; asked at every step, also within an episode."""
        limit = self.config.max_stay_steps
        return limit is not None and self.num_tasks > 1 and steps_in_visit >= limit

    def leave(self, task: int) -> SwitchTo:
        """The switch that :meth:`must_leave` demands within an episode."""
        return self._next(task, "max_stay_steps", {})

    def _next(self, task: int, reason: str, measured: dict[str, float]) -> SwitchTo:
        """i <- (i + 1) mod |E|, H_i <- []."""
        self.criterion.start_visit()
        return SwitchTo((task + 1) % self.num_tasks, reason, measured)
