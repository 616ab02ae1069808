"""Settings of evaluations, and of what a run writes."""

from __future__ import annotations

from dataclasses import dataclass

from switchmt_snn.config.checks import check_fields, require


@dataclass(frozen=True)
class EvaluationConfig:
    """The evaluation protocol; it is printed with every score."""

    episodes: int = 30
    """Episodes per task."""
    epsilon: float = 0.05
    """Share of random actions."""
    seed: int = 10_000
    """Seed of the evaluation's environments and random actions; separate from training."""
    num_envs: int = 8
    """Episodes played side by side."""
    max_episode_steps: int = 108_000
    """An episode that has not ended after so many steps is cut off, with the return that it has."""
    every_steps: int | None = None
    """Also evaluate during training, every so many steps; null only at its end."""
    stop_at_returns: tuple[float, ...] = ()
    """End training when an evaluation during training reaches these mean returns, one per task (CartPole-v1 counts as
    solved at 475). The final evaluation then plays other episodes (seed + 1). Empty: train for total_steps."""

    def __post_init__(self) -> None:
        check_fields(self, "evaluation")
        require(self.episodes >= 1, "evaluation.episodes", self.episodes, "at least 1")
        require(0.0 <= self.epsilon <= 1.0, "evaluation.epsilon", self.epsilon, "a probability in [0, 1]")
        require(self.seed >= 0, "evaluation.seed", self.seed, "at least 0")
        require(self.num_envs >= 1, "evaluation.num_envs", self.num_envs, "at least 1")
        require(self.max_episode_steps >= 1, "evaluation.max_episode_steps", self.max_episode_steps, "at least 1")
        require(
            self.every_steps is None or self.every_steps >= 1,
            "evaluation.every_steps",
            self.every_steps,
            "at least 1 or null",
        )
        if self.stop_at_returns:
            require(
                self.every_steps is not None,
                "evaluation.every_steps",
                self.every_steps,
                "a number of steps with evaluation.stop_at_returns",
                "training ends at one of its evaluations",
            )


@dataclass(frozen=True)
class RecordingConfig:
    """What a run writes while it trains; none of it changes what is learned."""

    checkpoint_every_steps: int = 50_000
    """Agent steps between two checkpoints."""
    keep_checkpoints: int = 2
    """Newest checkpoints kept for resume (the weights of the best one are kept, too)."""
    metrics_every_steps: int = 1_000
    """Agent steps between two rows of metrics.jsonl."""
    tensorboard: bool = False
    """Also write TensorBoard files (extra: tensorboard)."""
    trackio: bool = False
    """Also write to trackio, a dashboard on this machine (extra: trackio)."""

    def __post_init__(self) -> None:
        check_fields(self, "recording")
        require(
            self.checkpoint_every_steps >= 1,
            "recording.checkpoint_every_steps",
            self.checkpoint_every_steps,
            "at least 1",
        )
        require(self.keep_checkpoints >= 1, "recording.keep_checkpoints", self.keep_checkpoints, "at least 1")
        require(self.metrics_every_steps >= 1, "recording.metrics_every_steps", self.metrics_every_steps, "at least 1")
