"""The whole experiment as frozen dataclasses; every field is a YAML key and a command-line flag.

Units are in the names: ``_steps`` are agent steps (one decision, ``tasks.frame_skip`` emulator frames), ``_episodes``
are episodes, ``_frames`` are emulator frames. The paper's "frames" are agent steps (docs/algorithm.md, deviation 1).
The text under a field is its documentation: ``--help`` and docs/configuration.md are made from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from switchmt_snn.config.checks import check_fields, require
from switchmt_snn.config.evaluation import EvaluationConfig, RecordingConfig
from switchmt_snn.config.learning import LearningConfig
from switchmt_snn.config.methods import METHOD_TRAITS
from switchmt_snn.config.network import NetworkConfig
from switchmt_snn.config.suites import stored_suite_name, suite_defaults
from switchmt_snn.config.switching import SwitchingConfig
from switchmt_snn.config.tasks import TasksConfig, resolved_frame_stack


@dataclass(frozen=True)
class ExperimentConfig:
    """One training run."""

    name: str = "custom"
    """A short name; new run folders carry it."""
    seed: int = 1
    """Root seed of networks, exploration, sampling and environments."""
    total_steps: int = 12_000_000
    """Agent steps of the whole run, over all tasks."""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Where the network runs; auto takes cuda, else mps, else cpu."""
    threads: int | None = None
    """CPU threads of torch; null leaves torch's choice. A run that is continued keeps the number that it began with."""
    initial_weights: str | None = None
    """A run folder or pretrained/NAME of the same tasks and network: a new run begins with its last weights; null takes
    those of the seed. Replay, optimizer, epsilon and counters begin anew."""
    tasks: TasksConfig = field(default_factory=TasksConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    learning: LearningConfig = field(default_factory=LearningConfig)
    switching: SwitchingConfig = field(default_factory=SwitchingConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)

    def __post_init__(self) -> None:
        check_fields(self)
        plain = bool(self.name) and all(letter.isalnum() or letter in "-_." for letter in self.name)
        require(plain, "name", self.name, "letters, digits, '-', '_' and '.': it becomes part of a folder's name")
        require(self.seed >= 0, "seed", self.seed, "at least 0")
        require(self.total_steps >= 1, "total_steps", self.total_steps, "at least 1")
        require(self.threads is None or self.threads >= 1, "threads", self.threads, "at least 1 or null")
        require(
            self.network.quantiles == 1 or self.learning.loss == "huber",
            "learning.loss",
            self.learning.loss,
            f"huber with network.quantiles={self.network.quantiles}",
        )
        batches = self.learning.reestimate_statistics_batches
        require(
            batches == 0 or self.network.normalization == "per_task",
            "learning.reestimate_statistics_batches",
            batches,
            "0 with network.normalization=shared",
            "the statistics of one task would take the place of all tasks'",
        )
        if self.learning.first_layer_mean == "input":
            for key, expected in (("encoding", "direct"), ("normalization", "per_task")):
                value = getattr(self.network, key)
                require(value == expected, f"network.{key}", value, f"{expected} with learning.first_layer_mean=input")
        goals, names = self.evaluation.stop_at_returns, self.tasks.names
        require(
            len(goals) in (0, len(names)),
            "evaluation.stop_at_returns",
            list(goals),
            f"a return for each of {list(names)}, or none",
        )
        by_task = self.learning.longest_random_action_steps_by_task
        require(
            len(by_task) in (0, len(names)),
            "learning.longest_random_action_steps_by_task",
            list(by_task),
            f"a number of steps for each of {list(names)}, or none",
        )
        stack = resolved_frame_stack(self.tasks)
        per_env = self.learning.replay_capacity_steps // self.tasks.num_envs
        require(
            per_env > stack,
            "learning.replay_capacity_steps",
            self.learning.replay_capacity_steps,
            f"more than num_envs x frame_stack ({self.tasks.num_envs} x {stack})",
        )


def clips_rewards(config: ExperimentConfig) -> bool:
    """Whether rewards are clipped for learning; null takes the suite's default."""
    asked = config.learning.clip_rewards
    return suite_defaults(config.tasks.suite).clip_rewards if asked is None else asked


_HIDDEN_UNITS = {"nature": 512, "nature_half": 256}
"""Units of each stream's hidden layer where the config names none; 128 for other trunks."""


def resolve(config: ExperimentConfig) -> ExperimentConfig:
    """Replace every ``auto`` and null that has a rule; idempotent. A run stores the resolved config.

    ``device`` stays, so that a run can be continued on another machine; its environment.json names the device.
    """
    traits = METHOD_TRAITS[config.network.method]
    network = config.network
    trunk = suite_defaults(config.tasks.suite).trunk if network.trunk == "auto" else network.trunk
    dendrites = network.dendrites
    if dendrites == "auto":
        dendrites = "shared" if traits.dendrites else "none"
    network = replace(
        network,
        trunk=trunk,  # type: ignore[arg-type]
        dendrites=dendrites,
        hidden_units=network.hidden_units or _HIDDEN_UNITS.get(trunk, 128),
        timesteps=network.timesteps if traits.spiking else 1,
    )
    policy, tasks = config.switching.policy, config.tasks
    return replace(
        config,
        tasks=replace(tasks, suite=stored_suite_name(tasks.suite), frame_stack=resolved_frame_stack(tasks)),
        network=network,
        learning=replace(config.learning, clip_rewards=clips_rewards(config)),
        switching=replace(config.switching, policy=traits.switching if policy == "auto" else policy),
    )
