"""Settings of the tasks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from switchmt_snn.config.checks import check_fields, require
from switchmt_snn.config.plugins import is_plugin
from switchmt_snn.config.suites import require_suite_name, suite_defaults
from switchmt_snn.errors import did_you_mean

BUILT_IN_WRAPPERS = ("FlattenObservation", "FlattenAction")
"""Wrappers of ``tasks.wrappers`` that are named without a module."""


@dataclass(frozen=True)
class TasksConfig:
    """Which tasks are learned, and how their environments are set up."""

    suite: str = "atari"
    """Where names are looked up: atari, minatar, gym (Gymnasium ids), or package.module:Name, a Suite of your own."""
    names: tuple[str, ...] = ("pong", "breakout", "enduro")
    """Tasks in the order in which training visits them. In the gym suite, module:MyEnv-v0 imports module first."""
    later_names: tuple[str, ...] = ()
    """Tasks that change midway: what each of ``names`` is from ``later_from_steps`` on, its own name where it stays as
    it is. Names, outputs and replays stay; actions must be the same. Empty: no task changes."""
    later_from_steps: int | None = None
    """Agent steps of the run after which ``later_names`` are played, and evaluated. Episodes of tasks that change are
    cut off there."""
    wrappers: tuple[str, ...] = ()
    """gym suite: wrappers of every environment, the innermost first. FlattenObservation: Dict, Tuple and Discrete
    observations become vectors. FlattenAction: one action for every combination of a MultiDiscrete space. module:Name:
    a gymnasium.Wrapper of your own, called with the environment."""
    image_layout: Literal["by_shape", "channels_last", "channels_first"] = "by_shape"
    """gym suite: which axis of images with three axes holds the channels. by_shape: the shape tells; one that does not
    say is refused."""
    subprocesses: bool = False
    """gym suite: step every copy in a process of its own, all at the same time (Gymnasium's AsyncVectorEnv). For
    environments that take longer than a millisecond for a step; play is the same."""
    num_envs: int = 1
    """Copies of the current task that are stepped together; one vector step counts as this many agent steps."""
    frame_stack: int | None = None
    """Newest frames that form one observation; null takes the suite's number: atari 4, minatar and gym 1."""
    frame_skip: int = 4
    """Atari: emulator frames per agent step; the last two are max-pooled."""
    sticky_action_probability: float = 0.0
    """Atari and MinAtar: probability that the environment repeats the previous action instead of the new one."""
    noop_max: int = 30
    """Atari: an episode starts after 1 to this many no-op frames, drawn from the episode's seed."""
    fire_on_reset: bool = True
    """Atari: press FIRE once after a reset in games that wait for it (a greedy policy that never fires scores 0)."""
    full_action_space: bool = True
    """Atari: all 18 actions in every game, so that the tasks share one meaning per output."""
    minimal_action_mask: bool = False
    """Atari and MinAtar: all outputs stay, but a task takes only actions of its minimal set (Pong 6, Breakout 4,
    Enduro 9) in training, targets, evaluation and exports. Refused with full_action_space=false."""
    max_episode_frames: int = 108_000
    """Atari and MinAtar: an episode is truncated after this many frames (in Atari 108,000 are 30 minutes of play)."""

    def __post_init__(self) -> None:
        check_fields(self, "tasks")
        require_suite_name(self.suite)
        require(len(self.names) > 0, "tasks.names", self.names, "at least one task")
        require(len(set(self.names)) == len(self.names), "tasks.names", self.names, "every task once")
        self._require_change()
        for name in self.wrappers:
            require(
                name in BUILT_IN_WRAPPERS or is_plugin(name),
                "tasks.wrappers",
                name,
                f"{', '.join(BUILT_IN_WRAPPERS)}, or module:Name",
                f"use a wrapper of your own for others{did_you_mean(name, BUILT_IN_WRAPPERS)}",
            )
        require(self.num_envs >= 1, "tasks.num_envs", self.num_envs, "at least 1")
        require(
            self.frame_stack is None or self.frame_stack >= 1,
            "tasks.frame_stack",
            self.frame_stack,
            "at least 1 or null",
        )
        require(self.frame_skip >= 1, "tasks.frame_skip", self.frame_skip, "at least 1")
        require(
            self.full_action_space or not self.minimal_action_mask,
            "tasks.minimal_action_mask",
            self.minimal_action_mask,
            "false with tasks.full_action_space=false, which has no other outputs to mask",
            "choose one of the two",
        )
        p = self.sticky_action_probability
        require(0.0 <= p < 1.0, "tasks.sticky_action_probability", p, "a probability in [0, 1)")
        require(self.noop_max >= 0, "tasks.noop_max", self.noop_max, "at least 0")
        require(self.max_episode_frames >= 1, "tasks.max_episode_frames", self.max_episode_frames, "at least 1")

    def _require_change(self) -> None:
        later, start = self.later_names, self.later_from_steps
        require(
            len(later) in (0, len(self.names)),
            "tasks.later_names",
            later,
            f"one name for each of tasks.names ({len(self.names)}), or none",
        )
        require(
            not later or later != self.names,
            "tasks.later_names",
            later,
            "another name for one task at least",
            "leave it out where no task changes",
        )
        require(
            (start is None) == (not later),
            "tasks.later_from_steps",
            start,
            "null without tasks.later_names" if not later else "the step from which tasks.later_names are played",
        )
        require(start is None or start >= 1, "tasks.later_from_steps", start, "at least 1")


def resolved_frame_stack(tasks: TasksConfig) -> int:
    """Frames per observation; null takes the suite's default."""
    return tasks.frame_stack or suite_defaults(tasks.suite).frame_stack
