"""Settings of task switching."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from switchmt_snn.config.checks import check_fields, require
from switchmt_snn.config.plugins import PluginName, is_plugin, plugin_options

Policy = Literal[
    "fixed_episodes",
    "fixed_steps",
    "interleave",
    "parameter_change",
    "parameter_change_per_update",
    "reward_plateau",
    "parameter_and_reward",
    "value_change",
    "deficit",
    "learning_progress",
    "plateau_and_return",
    "harmonic_gain",
    "dormancy_guard",
]
POLICIES: tuple[str, ...] = get_args(Policy)


@dataclass(frozen=True)
class SwitchingConfig:
    """When training leaves a task (paper, Algorithm 1 and Eq. 3; docs/algorithm.md, Switching policies)."""

    policy: Literal["auto"] | Policy | PluginName = "auto"
    """fixed_episodes, fixed_steps, interleave, parameter_change (Eq. 3), parameter_change_per_update, reward_plateau,
    parameter_and_reward, value_change, deficit, learning_progress, plateau_and_return, harmonic_gain, dormancy_guard,
    or a class from outside the package, package.module:Class (docs/extending.md). auto: the method's own (SwitchMT:
    parameter_change, all others: fixed_episodes)."""
    options: tuple[str, ...] = ()
    """policy=package.module:Class: keyword arguments of the class, each as name=value. The other policies have none."""
    visit_episodes: int = 25
    """fixed_episodes: episodes per visit."""
    visit_steps: int = 10_000
    """fixed_steps, dormancy_guard: leave at the first episode end after this many steps. deficit, learning_progress,
    harmonic_gain: choose a task anew at the first episode end after this many."""
    window_episodes: int = 5
    """K of Eq. 3: the change of parameters or, for value_change, of Q-values is measured across this many episodes."""
    change_threshold: float = 0.10
    """parameter_change: leave when the relative change falls below this."""
    change_rate_fraction: float = 0.5
    """parameter_change_per_update, value_change: leave when the change per update is below this fraction of the visit's
    largest."""
    probe_observations: int = 64
    """value_change, dormancy_guard: observations of the task's replay, drawn anew for each visit, whose Q-values are
    compared, or at which a neuron fires or is silent."""
    silent_rise: float = 0.1
    """dormancy_guard: leave when the share of a layer's neurons that are silent rose by more than this in the visit."""
    reference_scores: tuple[float, ...] = ()
    """deficit, learning_progress, harmonic_gain: a raw score for each task, in order; deficit and harmonic_gain take a
    task that reaches it as learned. Empty: the suite's published scores of people, which these two need then;
    learning_progress takes the range of each task's own returns where there is none."""
    floor_scores: tuple[float, ...] = ()
    """deficit, learning_progress, harmonic_gain: what random play scores in each task, in order. Empty: the suite's
    published scores, or 0."""
    score_episodes: int = 20
    """deficit, harmonic_gain: a task's score is the mean return of this many of its newest episodes."""
    deficit_temperature: float = 0.2
    """deficit: a task's share of the steps is proportional to exp(deficit / temperature)."""
    progress_window_steps: int = 40_000
    """learning_progress, harmonic_gain: the slope of the returns is measured across this many of a task's own newest
    steps."""
    uniform_share: float = 0.2
    """deficit, learning_progress, harmonic_gain: this share of the steps is divided equally among all tasks."""
    check_every_steps: int = 50_000
    """plateau_and_return: play a task that was left on a plateau again after so many steps of the run."""
    check_episodes: int = 5
    """plateau_and_return: episodes of such a check."""
    fall_t: float = 2.0
    """plateau_and_return: a mean return that is this many standard errors below that of the plateau has fallen."""
    plateau_window_episodes: int = 20
    """reward_plateau, plateau_and_return: returns in the slope test."""
    plateau_t: float = 1.0
    """reward_plateau, plateau_and_return: a slope of fewer standard errors than this is not an improvement."""
    plateau_patience_episodes: int = 3
    """reward_plateau, plateau_and_return: leave after this many episode ends in a row without improvement
    (hysteresis)."""
    judge_learning: Literal["auto", "always", "after_updates"] = "auto"
    """When a policy that judges learning is asked. after_updates: only once the task's own replay has been learned from
    in this visit; parameter_change also leaves out windows without an update. always: at every episode end (the paper's
    listing, which takes a change of 0 while the replay fills for convergence). auto: after_updates, but always for runs
    that began before this setting."""
    min_stay_episodes: int = 0
    """No policy leaves before this many episodes of the visit (the released script: 25)."""
    min_stay_steps: int = 0
    """No policy leaves before this many steps of the visit."""
    max_stay_steps: int | None = None
    """Leave at this many steps of the visit in any case, also within an episode; null never."""

    def __post_init__(self) -> None:
        check_fields(self, "switching")
        fits = not self.options or is_plugin(self.policy)
        require(fits, "switching.options", self.options, f"none for policy {self.policy}")
        plugin_options(self.options, "switching.options")
        counts = ("visit_episodes", "visit_steps", "window_episodes", "plateau_patience_episodes", "probe_observations")
        for name in (*counts, "score_episodes", "progress_window_steps", "check_every_steps", "check_episodes"):
            value = getattr(self, name)
            require(value >= 1, f"switching.{name}", value, "at least 1")
        w = self.plateau_window_episodes
        require(w >= 3, "switching.plateau_window_episodes", w, "at least 3", "a slope with an error needs 3 points")
        require(self.plateau_t >= 0, "switching.plateau_t", self.plateau_t, "at least 0")
        require(self.change_threshold > 0, "switching.change_threshold", self.change_threshold, "above 0")
        f = self.change_rate_fraction
        require(0 < f < 1, "switching.change_rate_fraction", f, "within (0, 1)")
        require(0 < self.silent_rise < 1, "switching.silent_rise", self.silent_rise, "within (0, 1)")
        t = self.deficit_temperature
        require(t > 0, "switching.deficit_temperature", t, "above 0")
        require(0 <= self.uniform_share <= 1, "switching.uniform_share", self.uniform_share, "within [0, 1]")
        require(self.fall_t >= 0, "switching.fall_t", self.fall_t, "at least 0")
        require(self.min_stay_episodes >= 0, "switching.min_stay_episodes", self.min_stay_episodes, "at least 0")
        require(self.min_stay_steps >= 0, "switching.min_stay_steps", self.min_stay_steps, "at least 0")
        if self.max_stay_steps is not None:
            require(
                self.max_stay_steps >= max(1, self.min_stay_steps),
                "switching.max_stay_steps",
                self.max_stay_steps,
                f"at least 1 and at least min_stay_steps ({self.min_stay_steps})",
            )
