"""Settings of double-DQN learning and of the replay memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from switchmt_snn.config.checks import check_fields, require

Engine = Literal["eager", "native", "compiled", "graph"]


@dataclass(frozen=True)
class LearningConfig:
    """Double-DQN learning and the replay memory (paper, Eq. 2 and Table 2)."""

    batch_size: int = 512
    """Transitions per update; all from one task."""
    learning_rate: float = 1e-4
    """Adam's learning rate."""
    learning_rate_decay_updates: int | None = None
    """Lower the learning rate linearly to 0 over this many updates; null keeps it. Later updates do not
    change the weights."""
    adam_epsilon: float = 1e-8
    """Adam's epsilon."""
    discount: float = 0.99
    """Discount factor gamma."""
    n_steps: int = 1
    """Rewards that a target adds up before the bootstrapped value (1: Eq. 2). A sum ends early with its episode."""
    double_q: bool = True
    """Choose the next action with the online network and value it with the target network (Eq. 2). false: the target
    network chooses it, too, which saves the online network's pass over the next observations."""
    loss: Literal["mse", "huber"] = "mse"
    """Squared error (paper), or Huber with delta 1. With network.quantiles above 1, huber is the quantile Huber loss
    (kappa 1), and mse is refused."""
    gradient_clip: Literal["none", "value", "norm"] = "none"
    """Clamp each gradient element, or scale the whole gradient to a largest norm."""
    gradient_clip_at: float = 1.0
    """The bound of gradient_clip."""
    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    """Number format of the matrix products in an update. Everything else is float32. auto: bfloat16 if the hardware has
    it, else float32."""
    engine: Literal["auto"] | Engine = "auto"
    """How updates are executed. eager: PyTorch. native: C++ (CPU only, compiled once in about 7 s). compiled:
    torch.compile (20-35 s at each start). graph: a CUDA graph. Engines differ in rounding. auto: native for long runs
    on vectors, and for Atari-size networks if AVX-512 or bfloat16 is available; compiled for runs of 150,000 updates or
    more; else eager."""
    acting_network: Literal["online", "target"] = "online"
    """By whose Q-values training acts: Q's, or those of Q*, whose weights stay with their BatchNorm statistics from one
    copy to the next. This network is stored as the run's model, evaluated, exported and filmed."""
    next_statistics: Literal["running", "batch"] = "running"
    """What BatchNorm normalizes the next states by, in Q* and in the choice of Q: running statistics, which lag behind
    Q's weights, or those of the batch, as in the pass that is trained."""
    acting: Literal["auto", "eager", "native"] = "auto"
    """Who computes the actions of training, in float32 whatever learning.precision is: eager (PyTorch) or native (the
    native engine). Evaluation is always eager. auto: native with engine native, else eager."""
    clip_rewards: bool | None = None
    """Clip every reward to [-1, 1] before targets are made; logs and scores always hold the raw reward. null takes the
    suite's choice: atari and minatar true, gym false."""
    return_normalization: Literal["none", "per_task"] = "none"
    """per_task: divide the TD errors of each task by the size of its returns, so that tasks with large returns do not
    outweigh the others. Q-values stay in the task's rewards; the loss is in these units (docs/algorithm.md, 32)."""
    life_loss_is_terminal: bool = False
    """Targets treat the loss of a life as terminal. The episode goes on, and returns and evaluation are as before.
    Refused if no task has lives."""
    replay_capacity_steps: int = 1_048_576
    """Transitions kept per task."""
    replay_compression: Literal["auto", "zstd", "none"] = "auto"
    """Keep frames compressed, without loss and with the same samples. auto: if plain ones would take over 1 GiB."""
    replay_max_gib: float = 4.0
    """Upper limit for all compressed frames together; when it is reached, the oldest frames are dropped."""
    replay_on_device: bool = False
    """Store frames uncompressed on the network's device (GPU), and assemble batches there."""
    learning_starts_steps: int = 512
    """Transitions that a task must hold before it is sampled; until then its actions are random."""
    update_every_steps: int = 1
    """Agent steps between two rounds of updates."""
    updates_per_round: int = 1
    """Updates that a round makes one after the other; with update_tasks all, so many for every task."""
    overlap: bool = False
    """Step the environments on another thread while an update runs. Actions then come from the network before the
    current update instead of after it."""
    update_tasks: Literal["current", "all"] = "current"
    """Sample the current task's buffer (paper), or make one update from every task's buffer in turn (script)."""
    target_update_every_steps: int = 10_000
    """Agent steps between two copies of the network into the target network."""
    target_update_every_updates: int | None = None
    """Count these copies in updates, over all tasks: a number takes the place of target_update_every_steps."""
    reestimate_statistics_batches: int = 0
    """Re-estimate BatchNorm's running statistics of Q from so many batches of each task's replay: before each copy to
    Q*, when a visit to the task starts, and if Q acts before an evaluation and at the end. Running statistics belong to
    past weights: targets are biased, and a task that was away looks forgotten. 0: off."""
    first_layer_mean: Literal["running", "input"] = "running"
    """Where BatchNorm takes the first layer's running mean from. running: the mean of its currents over past updates.
    input: its present weights times the running mean input, set after every update, so that the network that acts is
    the one that learns. Over a bright, constant background (Pong) the former lags far behind."""
    epsilon_start: float = 1.0
    """Exploration at the first step."""
    epsilon_end: float = 0.1
    """Exploration after the decay."""
    epsilon_decay_steps: int = 1_000_000
    """Steps of the linear decay from start to end."""
    epsilon_clock: Literal["total", "task"] = "total"
    """Count the decay in steps of the whole run (paper), or in steps of the task that is played."""
    longest_random_action_steps: int = 1
    """A random action is kept for n steps, with probability proportional to 1/n^2, at most so many. Epsilon is then the
    probability of beginning one. 1: one step (paper). 100 finds rewards that need a held action (Enduro)."""
    longest_random_action_steps_by_task: tuple[int, ...] = ()
    """``longest_random_action_steps`` of each task, in the order of tasks.names; empty: the same for all. Held actions
    find rewards in one game and none in another."""

    def __post_init__(self) -> None:
        check_fields(self, "learning")
        require(self.batch_size >= 2, "learning.batch_size", self.batch_size, "at least 2", "BatchNorm needs a batch")
        require(self.learning_rate > 0, "learning.learning_rate", self.learning_rate, "above 0")
        decay = self.learning_rate_decay_updates
        require(decay is None or decay >= 1, "learning.learning_rate_decay_updates", decay, "at least 1 or null")
        require(self.adam_epsilon > 0, "learning.adam_epsilon", self.adam_epsilon, "above 0")
        require(0.0 <= self.discount <= 1.0, "learning.discount", self.discount, "within [0, 1]")
        require(self.gradient_clip_at > 0, "learning.gradient_clip_at", self.gradient_clip_at, "above 0")
        if self.replay_on_device:
            require(self.replay_compression != "zstd", "learning.replay_compression", "zstd", "none on a device")
        require(self.replay_max_gib > 0, "learning.replay_max_gib", self.replay_max_gib, "above 0")
        for name in (
            "n_steps",
            "replay_capacity_steps",
            "update_every_steps",
            "updates_per_round",
            "target_update_every_steps",
            "target_update_every_updates",
            "epsilon_decay_steps",
            "longest_random_action_steps",
        ):
            value = getattr(self, name)
            require(value is None or value >= 1, f"learning.{name}", value, "at least 1")
        by_task = self.longest_random_action_steps_by_task
        key = "learning.longest_random_action_steps_by_task"
        require(min(by_task, default=1) >= 1, key, list(by_task), "at least 1")
        require(
            self.batch_size <= self.replay_capacity_steps,
            "learning.batch_size",
            self.batch_size,
            f"at most replay_capacity_steps ({self.replay_capacity_steps})",
            "lower the batch or raise the capacity",
        )
        require(
            self.batch_size <= self.learning_starts_steps <= self.replay_capacity_steps,
            "learning.learning_starts_steps",
            self.learning_starts_steps,
            f"between batch_size ({self.batch_size}) and replay_capacity_steps ({self.replay_capacity_steps})",
        )
        batches = self.reestimate_statistics_batches
        require(batches >= 0, "learning.reestimate_statistics_batches", batches, "at least 0")
        for name in ("epsilon_start", "epsilon_end"):
            value = getattr(self, name)
            require(0.0 <= value <= 1.0, f"learning.{name}", value, "a probability in [0, 1]")
