"""The whole experiment as frozen dataclasses; every field is a YAML key and a command-line flag.

Units are in the names: ``_steps`` are agent steps (one decision, ``tasks.frame_skip`` emulator frames), ``_episodes``
are episodes, ``_frames`` are emulator frames. The paper's "frames" are agent steps (docs/algorithm.md, deviation 1).
The text under a field is its documentation: ``--help`` and docs/configuration.md are made from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from switchmt_snn.config.plugins import PluginName
from switchmt_snn.config.suites import require_suite_name, stored_suite_name, suite_defaults
from switchmt_snn.errors import ConfigError

Method = Literal["DQN", "DSQN", "DQN_D", "DSQN_D", "MTSpark_AD", "MTSpark_ADD", "SwitchMT"]
Engine = Literal["eager", "native", "compiled", "graph"]
Policy = Literal[
    "fixed_episodes",
    "fixed_steps",
    "interleave",
    "parameter_change",
    "parameter_change_per_update",
    "reward_plateau",
    "parameter_and_reward",
]


@dataclass(frozen=True)
class MethodTraits:
    """What a method name of the paper stands for (ALGORITHM section 1; paper, Table 3)."""

    spiking: bool
    dueling: bool
    dendrites: bool
    switching: Policy


METHOD_TRAITS: dict[str, MethodTraits] = {
    "DQN": MethodTraits(spiking=False, dueling=False, dendrites=False, switching="fixed_episodes"),
    "DSQN": MethodTraits(spiking=True, dueling=False, dendrites=False, switching="fixed_episodes"),
    "DQN_D": MethodTraits(spiking=False, dueling=True, dendrites=False, switching="fixed_episodes"),
    "DSQN_D": MethodTraits(spiking=True, dueling=True, dendrites=False, switching="fixed_episodes"),
    "MTSpark_AD": MethodTraits(spiking=True, dueling=False, dendrites=True, switching="fixed_episodes"),
    "MTSpark_ADD": MethodTraits(spiking=True, dueling=True, dendrites=True, switching="fixed_episodes"),
    "SwitchMT": MethodTraits(spiking=True, dueling=True, dendrites=True, switching="parameter_change"),
}
"""The seven methods that the paper compares."""


def _require(holds: bool, key: str, seen: object, expected: str, remedy: str = "") -> None:
    if not holds:
        raise ConfigError(f"{key} is {seen!r}, expected {expected}{'; ' + remedy if remedy else ''}")


@dataclass(frozen=True)
class TasksConfig:
    """Which tasks are learned, and how their environments are set up."""

    suite: str = "atari"
    """Where names are looked up: atari, minatar, gym (Gymnasium ids), or package.module:Name, a Suite of your own."""
    names: tuple[str, ...] = ("pong", "breakout", "enduro")
    """Tasks in the order in which training visits them. In the gym suite, module:MyEnv-v0 imports module first."""
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
    max_episode_frames: int = 108_000
    """Atari and MinAtar: an episode is truncated after this many frames (in Atari 108,000 are 30 minutes of play)."""

    def __post_init__(self) -> None:
        require_suite_name(self.suite)
        _require(len(self.names) > 0, "tasks.names", self.names, "at least one task")
        _require(len(set(self.names)) == len(self.names), "tasks.names", self.names, "every task once")
        _require(self.num_envs >= 1, "tasks.num_envs", self.num_envs, "at least 1")
        _require(self.frame_stack is None or self.frame_stack >= 1, "tasks.frame_stack", self.frame_stack, ">= 1")
        _require(self.frame_skip >= 1, "tasks.frame_skip", self.frame_skip, "at least 1")
        p = self.sticky_action_probability
        _require(0.0 <= p < 1.0, "tasks.sticky_action_probability", p, "a probability in [0, 1)")
        _require(self.noop_max >= 0, "tasks.noop_max", self.noop_max, "at least 0")
        _require(self.max_episode_frames >= 1, "tasks.max_episode_frames", self.max_episode_frames, "at least 1")


@dataclass(frozen=True)
class NetworkConfig:
    """The spiking Q-network (or its ANN twin): method, trunk, neurons, time, encoding, dendrites, normalisation."""

    method: Method = "SwitchMT"
    """DQN, DSQN, DQN_D, DSQN_D, MTSpark_AD, MTSpark_ADD or SwitchMT: fixes neurons, dueling structure and dendrites."""
    trunk: Literal["auto", "nature", "minatar", "mlp"] = "auto"
    """Feature layers: three convolutions (84x84), one (10x10), or one linear layer; auto follows tasks.suite."""
    hidden_units: int | None = None
    """Units of each stream's hidden layer; null takes 512 for nature and 128 otherwise."""
    timesteps: int = 4
    """Simulation steps T per decision; ANN methods have none and resolve to 1."""
    encoding: Literal["direct", "rate", "latency", "frames", "events"] = "direct"
    """How an observation becomes T inputs; see docs/algorithm.md, Encodings."""
    event_threshold: float = 0.02
    """encoding=events: an ON or OFF spike where the scaled pixel moved by more than this between frames."""
    readout: Literal["mean", "last_membrane", "max_membrane"] = "mean"
    """Q from the head's output over time: its mean, or the last or largest membrane of a non-spiking integrator."""
    readout_beta: float = 1.0
    """Decay per step of the non-spiking integrator that the two membrane readouts use."""
    neuron: Literal["IF", "LIF", "Synaptic", "ALIF"] | PluginName = "IF"
    """IF, LIF (IF with the decay `beta`), Synaptic (LIF fed by a decaying current), ALIF (LIF whose threshold rises
    with its spikes), or a class from outside the package, package.module:Class (docs/algorithm.md, Neurons)."""
    beta: float = 0.5
    """Membrane decay per simulation step (0.5 is the released script's tau of 2). neuron=IF does not use it."""
    alpha: float = 0.5
    """neuron=Synaptic: decay of the synaptic current per simulation step. IF, LIF and ALIF do not use it."""
    adaptation_decay: float = 0.9
    """neuron=ALIF: decay of the threshold's rise per simulation step. IF, LIF and Synaptic do not use it."""
    adaptation_strength: float = 0.2
    """neuron=ALIF: rise of the threshold by one spike. IF, LIF and Synaptic do not use it."""
    learn_beta: bool = False
    """Train one decay per layer."""
    threshold: float = 1.0
    """Firing threshold; a neuron fires when its membrane is strictly above it."""
    learn_threshold: bool = False
    """Train one threshold per layer."""
    reset: Literal["zero", "subtract"] = "zero"
    """What a spike does to the membrane: set it to zero, or subtract the threshold (docs/algorithm.md, Neurons)."""
    surrogate: Literal[
        "atan",
        "sigmoid",
        "fast_sigmoid",
        "triangular",
        "straight_through_estimator",
        "spike_rate_escape",
        "SFS",
        "SSO",
        "heaviside",
    ] = "atan"
    """Surrogate gradient: a function of snntorch.surrogate (its LSO cannot be called in snnTorch 1.0.0)."""
    surrogate_slope: float | None = None
    """Slope (alpha) of the surrogate; null takes snnTorch's default."""
    dendrites: Literal["auto", "none", "shared", "per_neuron"] = "auto"
    """Segments shared by a stream (the paper's 18 weights), or own ones per neuron; auto follows the method."""
    dendritic_segments: int = 3
    """Segments per neuron (or per stream, when shared)."""
    dendritic_gating: Literal["max", "absolute_max"] = "max"
    """Which segment speaks: the largest response, or the one largest in absolute value (sign kept)."""
    k_winners: int | None = None
    """Keep only the k largest gated input currents per simulation step in each stream (of equals the lower index); null
    keeps all."""
    normalization: Literal["per_task", "shared"] = "per_task"
    """BatchNorm running statistics for each task, or one set for all (affine weights are always shared)."""
    normalization_momentum: float = 0.1
    """BatchNorm momentum of the running statistics."""
    neuron_engine: Literal["fused", "snntorch"] = "fused"
    """fused: this package's code (IF and LIF: one autograd function, the same arithmetic as snn.Leaky). snntorch: calls
    snnTorch's neuron step by step (IF, LIF, Synaptic)."""

    def __post_init__(self) -> None:
        _require(self.hidden_units is None or self.hidden_units >= 1, "network.hidden_units", self.hidden_units, ">= 1")
        _require(self.timesteps >= 1, "network.timesteps", self.timesteps, "at least 1")
        for key in ("beta", "alpha", "adaptation_decay"):
            _require(0.0 <= getattr(self, key) <= 1.0, f"network.{key}", getattr(self, key), "a decay in [0, 1]")
        _require(self.adaptation_strength >= 0.0, "network.adaptation_strength", self.adaptation_strength, "at least 0")
        _require(0.0 <= self.readout_beta <= 1.0, "network.readout_beta", self.readout_beta, "a decay in [0, 1]")
        _require(self.threshold > 0.0, "network.threshold", self.threshold, "above 0")
        _require(0.0 < self.event_threshold < 1.0, "network.event_threshold", self.event_threshold, "within (0, 1)")
        _require(self.dendritic_segments >= 1, "network.dendritic_segments", self.dendritic_segments, "at least 1")
        _require(
            self.k_winners is None or self.k_winners >= 1, "network.k_winners", self.k_winners, "at least 1 or null"
        )
        m = self.normalization_momentum
        _require(0.0 < m <= 1.0, "network.normalization_momentum", m, "within (0, 1]")
        traits = METHOD_TRAITS.get(self.method)
        _require(traits is not None, "network.method", self.method, f"one of {', '.join(METHOD_TRAITS)}")
        assert traits is not None
        if not traits.dendrites:
            _require(
                self.dendrites in ("auto", "none"),
                "network.dendrites",
                self.dendrites,
                f"none for method {self.method}",
                "MTSpark_AD and SwitchMT are the methods with active dendrites",
            )
        if not traits.spiking:
            _require(
                self.encoding == "direct",
                "network.encoding",
                self.encoding,
                f"direct for the ANN method {self.method}",
                "an ANN has no simulation steps to encode over",
            )
            _require(self.readout == "mean", "network.readout", self.readout, f"mean for the ANN method {self.method}")
            _require(self.k_winners is None, "network.k_winners", self.k_winners, "null for a method without dendrites")


@dataclass(frozen=True)
class LearningConfig:
    """Double-DQN learning and the replay memory (paper, Eq. 2 and Table 2)."""

    batch_size: int = 512
    """Transitions per update; all from one task."""
    learning_rate: float = 1e-4
    """Adam's learning rate."""
    adam_epsilon: float = 1e-8
    """Adam's epsilon."""
    discount: float = 0.99
    """Discount factor gamma."""
    double_q: bool = True
    """Choose the next action with the online network and value it with the target network (Eq. 2)."""
    loss: Literal["mse", "huber"] = "mse"
    """Squared error (paper), or Huber with delta 1."""
    gradient_clip: Literal["none", "value", "norm"] = "none"
    """Clamp each gradient element, or scale the whole gradient to a largest norm."""
    gradient_clip_at: float = 1.0
    """The bound of gradient_clip."""
    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    """Synaptic products of an update; everything else, and acting, is float32. bfloat16 is faster where the processor
    has it (AVX512-BF16, AMX, GPUs), and works, slower, elsewhere; auto takes it where it is there."""
    engine: Literal["auto"] | Engine = "auto"
    """Updates operation by operation (eager), in C++ (native: CPU; built once, some 7 s), compiled by torch.compile (20
    to 35 s per start), or compiled into a CUDA graph; each rounds in its own way. auto, on a CPU with a C++ compiler:
    native for the nature trunk (AVX-512 or bfloat16), compiled from 150,000 updates on; else eager."""
    clip_rewards: bool = True
    """Clip rewards to [-1, 1] in the learner; logs and scores always hold the raw reward."""
    replay_capacity_steps: int = 1_048_576
    """Transitions kept per task."""
    replay_compression: Literal["auto", "zstd", "none"] = "auto"
    """Keep frames compressed, without loss and with the same samples. auto: if plain ones would take over 1 GiB."""
    replay_max_gib: float = 4.0
    """Compressed frames of all tasks together take no more; while they would, the oldest leave."""
    replay_on_device: bool = False
    """Keep frames as plain bytes where the network lies (a GPU's memory), so that batches are gathered there."""
    learning_starts_steps: int = 512
    """Transitions that a task must hold before it is sampled; until then its actions are random."""
    update_every_steps: int = 1
    """Agent steps between two updates."""
    overlap: bool = False
    """Step the environments on another thread while an update runs. An action is then chosen before the update of its
    step instead of after it; else the loop is the same."""
    update_tasks: Literal["current", "all"] = "current"
    """Sample the current task's buffer (paper), or make one update from every task's buffer in turn (script)."""
    target_update_every_steps: int = 10_000
    """Agent steps between two copies of the network into the target network."""
    epsilon_start: float = 1.0
    """Exploration at the first step."""
    epsilon_end: float = 0.1
    """Exploration after the decay."""
    epsilon_decay_steps: int = 1_000_000
    """Steps of the linear decay from start to end."""
    epsilon_clock: Literal["total", "task"] = "total"
    """Count the decay in steps of the whole run (paper), or in steps of the task that is played."""

    def __post_init__(self) -> None:
        _require(self.batch_size >= 2, "learning.batch_size", self.batch_size, "at least 2", "BatchNorm needs a batch")
        _require(self.learning_rate > 0, "learning.learning_rate", self.learning_rate, "above 0")
        _require(self.adam_epsilon > 0, "learning.adam_epsilon", self.adam_epsilon, "above 0")
        _require(0.0 <= self.discount <= 1.0, "learning.discount", self.discount, "within [0, 1]")
        _require(self.gradient_clip_at > 0, "learning.gradient_clip_at", self.gradient_clip_at, "above 0")
        if self.replay_on_device:
            _require(self.replay_compression != "zstd", "learning.replay_compression", "zstd", "none on a device")
        _require(self.replay_max_gib > 0, "learning.replay_max_gib", self.replay_max_gib, "above 0")
        for name in ("replay_capacity_steps", "update_every_steps", "target_update_every_steps", "epsilon_decay_steps"):
            value = getattr(self, name)
            _require(value >= 1, f"learning.{name}", value, "at least 1")
        _require(
            self.batch_size <= self.replay_capacity_steps,
            "learning.batch_size",
            self.batch_size,
            f"at most replay_capacity_steps ({self.replay_capacity_steps})",
            "lower the batch or raise the capacity",
        )
        _require(
            self.batch_size <= self.learning_starts_steps <= self.replay_capacity_steps,
            "learning.learning_starts_steps",
            self.learning_starts_steps,
            f"between batch_size ({self.batch_size}) and replay_capacity_steps ({self.replay_capacity_steps})",
        )
        for name in ("epsilon_start", "epsilon_end"):
            value = getattr(self, name)
            _require(0.0 <= value <= 1.0, f"learning.{name}", value, "a probability in [0, 1]")


@dataclass(frozen=True)
class SwitchingConfig:
    """When training leaves a task (paper, Algorithm 1 and Eq. 3; docs/algorithm.md, Switching policies)."""

    policy: Literal["auto"] | Policy = "auto"
    """fixed_episodes, fixed_steps, interleave, parameter_change (Eq. 3), parameter_change_per_update, reward_plateau or
    parameter_and_reward; auto takes the method's own (SwitchMT: parameter_change, all others: fixed_episodes)."""
    visit_episodes: int = 25
    """fixed_episodes: episodes per visit."""
    visit_steps: int = 10_000
    """fixed_steps: leave at the first episode end after this many steps."""
    window_episodes: int = 5
    """K of Eq. 3: the parameter change is measured across this many episodes."""
    change_threshold: float = 0.10
    """parameter_change: leave when the relative change falls below this."""
    change_rate_fraction: float = 0.5
    """parameter_change_per_update: leave when the change per update is below this fraction of the visit's largest."""
    plateau_window_episodes: int = 20
    """reward_plateau: returns in the slope test."""
    plateau_t: float = 1.0
    """reward_plateau: a slope of fewer standard errors than this is not an improvement."""
    plateau_patience_episodes: int = 3
    """reward_plateau: leave after this many episode ends in a row without improvement (hysteresis)."""
    min_stay_episodes: int = 0
    """No policy leaves before this many episodes of the visit (the released script: 25)."""
    min_stay_steps: int = 0
    """No policy leaves before this many steps of the visit."""
    max_stay_steps: int | None = None
    """Leave at this many steps of the visit in any case, also within an episode; null never."""

    def __post_init__(self) -> None:
        for name in ("visit_episodes", "visit_steps", "window_episodes", "plateau_patience_episodes"):
            value = getattr(self, name)
            _require(value >= 1, f"switching.{name}", value, "at least 1")
        w = self.plateau_window_episodes
        _require(w >= 3, "switching.plateau_window_episodes", w, "at least 3", "a slope with an error needs 3 points")
        _require(self.change_threshold > 0, "switching.change_threshold", self.change_threshold, "above 0")
        f = self.change_rate_fraction
        _require(0 < f < 1, "switching.change_rate_fraction", f, "within (0, 1)")
        _require(self.min_stay_episodes >= 0, "switching.min_stay_episodes", self.min_stay_episodes, "at least 0")
        _require(self.min_stay_steps >= 0, "switching.min_stay_steps", self.min_stay_steps, "at least 0")
        if self.max_stay_steps is not None:
            _require(
                self.max_stay_steps >= max(1, self.min_stay_steps),
                "switching.max_stay_steps",
                self.max_stay_steps,
                f"at least 1 and at least min_stay_steps ({self.min_stay_steps})",
            )


@dataclass(frozen=True)
class EvaluationConfig:
    """The evaluation protocol; it is printed beside every score."""

    episodes: int = 30
    """Episodes per task."""
    epsilon: float = 0.05
    """Share of random actions."""
    seed: int = 10_000
    """Seed of the evaluation's environments and random actions; separate from training."""
    num_envs: int = 8
    """Episodes played side by side."""
    every_steps: int | None = None
    """Also evaluate during training, every so many steps; null only at its end."""

    def __post_init__(self) -> None:
        _require(self.episodes >= 1, "evaluation.episodes", self.episodes, "at least 1")
        _require(0.0 <= self.epsilon <= 1.0, "evaluation.epsilon", self.epsilon, "a probability in [0, 1]")
        _require(self.seed >= 0, "evaluation.seed", self.seed, "at least 0")
        _require(self.num_envs >= 1, "evaluation.num_envs", self.num_envs, "at least 1")
        _require(self.every_steps is None or self.every_steps >= 1, "evaluation.every_steps", self.every_steps, ">= 1")


@dataclass(frozen=True)
class RecordingConfig:
    """What a run writes while it trains; none of it changes what is learned."""

    checkpoint_every_steps: int = 50_000
    """Agent steps between two checkpoints."""
    keep_checkpoints: int = 2
    """Newest checkpoints kept for resume (the best one is kept as weights besides)."""
    metrics_every_steps: int = 1_000
    """Agent steps between two rows of metrics.jsonl."""
    tensorboard: bool = False
    """Also write TensorBoard files (extra: tensorboard)."""

    def __post_init__(self) -> None:
        _require(
            self.checkpoint_every_steps >= 1, "recording.checkpoint_every_steps", self.checkpoint_every_steps, ">= 1"
        )
        _require(self.keep_checkpoints >= 1, "recording.keep_checkpoints", self.keep_checkpoints, "at least 1")
        _require(self.metrics_every_steps >= 1, "recording.metrics_every_steps", self.metrics_every_steps, "at least 1")


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
    """CPU threads of torch; null leaves torch's choice. Exact resume needs the same number."""
    tasks: TasksConfig = field(default_factory=TasksConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    learning: LearningConfig = field(default_factory=LearningConfig)
    switching: SwitchingConfig = field(default_factory=SwitchingConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)

    def __post_init__(self) -> None:
        plain = bool(self.name) and all(letter.isalnum() or letter in "-_." for letter in self.name)
        _require(plain, "name", self.name, "letters, digits, '-', '_' and '.': it becomes part of a folder's name")
        _require(self.seed >= 0, "seed", self.seed, "at least 0")
        _require(self.total_steps >= 1, "total_steps", self.total_steps, "at least 1")
        _require(self.threads is None or self.threads >= 1, "threads", self.threads, "at least 1 or null")
        stack = resolved_frame_stack(self.tasks)
        if self.network.encoding in ("frames", "events"):
            _require(
                self.network.timesteps == stack,
                "network.timesteps",
                self.network.timesteps,
                f"tasks.frame_stack ({stack}) for encoding={self.network.encoding}, one stacked frame per step",
            )
        per_env = self.learning.replay_capacity_steps // self.tasks.num_envs
        _require(
            per_env > stack,
            "learning.replay_capacity_steps",
            self.learning.replay_capacity_steps,
            f"more than num_envs x frame_stack ({self.tasks.num_envs} x {stack})",
        )


def resolved_frame_stack(tasks: TasksConfig) -> int:
    """Frames per observation; null takes the suite's default."""
    return tasks.frame_stack or suite_defaults(tasks.suite).frame_stack


def resolve(config: ExperimentConfig) -> ExperimentConfig:
    """Replace every ``auto`` and null that has a rule; idempotent. A run stores the resolved config.

    ``device`` stays: it names a wish ("the best that is there"), and the run's environment.json records the answer.
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
        hidden_units=network.hidden_units or (512 if trunk == "nature" else 128),
        timesteps=network.timesteps if traits.spiking else 1,
    )
    policy, tasks = config.switching.policy, config.tasks
    return replace(
        config,
        tasks=replace(tasks, suite=stored_suite_name(tasks.suite), frame_stack=resolved_frame_stack(tasks)),
        network=network,
        switching=replace(config.switching, policy=traits.switching if policy == "auto" else policy),
    )


POLICIES: tuple[str, ...] = get_args(Policy)
METHODS: tuple[str, ...] = get_args(Method)
