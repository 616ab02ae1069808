"""The paper's criterion, Eq. 3: the parameters hardly change any more."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.errors import require_saved
from switchmt_snn.learning.switching.criterion import Criterion, Deciding, EpisodeRecord, Verdict, register_criterion


@register_criterion("parameter_change")
class ParameterChange(Criterion):
    """Eq. 3: leave when ``||theta_t - theta_(t-K)||_2 / ||theta_(t-K)||_2`` falls below the threshold (10 %).

    H holds K + 1 snapshots, so that the change spans K episodes as Eq. 3 says (the listing's K snapshots span K - 1;
    docs/algorithm.md, deviation 2). A window in which no update was made says nothing about learning, so it decides
    nothing, unless ``switching.judge_learning`` is ``always``.
    """

    columns = ("parameter_change", "change_threshold", "snapshots")
    deciding = (Deciding("parameter_change", ("change_threshold",)),)
    needs_network: ClassVar = {"parameter_change": ("window_episodes",)}
    SAVED = ("history", "updates")
    DERIVED = ("window_episodes", "threshold", "always")

    def __init__(self, config: SwitchingConfig) -> None:
        self.window_episodes = config.window_episodes
        self.threshold = config.change_threshold
        self.always = config.judge_learning == "always"
        self.start_visit()

    @classmethod
    def snapshots(cls, config: SwitchingConfig) -> int:
        """K + 1, and the newest one before the oldest one is dropped."""
        return config.window_episodes + 2

    def start_visit(self) -> None:
        """H_i <- []."""
        self.history: list[Tensor] = []
        self.updates: list[int] = []

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Append theta_t to H_i; measure the relative change over K episodes."""
        append_snapshot(self.history, record)
        self.updates.append(record.updates)
        measured = {"change_threshold": self.threshold, "snapshots": float(len(self.updates))}
        if len(self.updates) <= self.window_episodes:
            return Verdict(False, "window_fills", measured)
        for values in (self.history, self.updates):
            del values[: len(values) - self.window_episodes - 1]
        change = change_over(self.history, record)
        measured |= {"parameter_change": change, "snapshots": float(len(self.updates))}
        if self.updates[0] == self.updates[-1] and not self.always:
            return Verdict(False, "no_updates_in_window", measured)
        summary = f"change {change:.1%} of {self.threshold:.1%}"
        return Verdict(change < self.threshold, "parameter_change", measured, summary)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put a saved state back; states of runs that began before updates were kept have none, nor use any."""
        require_saved(state, ("history",), type(self).__name__)
        count = len(state["history"]) if isinstance(state["history"], list) else 0
        super().load_state_dict({"updates": [0] * count, **state})


def append_snapshot(history: list[Tensor], record: EpisodeRecord) -> None:
    """Append theta_t; a replayed run has none."""
    if record.recorded is None:
        history.append(record.parameters())


def change_over(history: list[Tensor], record: EpisodeRecord) -> float:
    """Relative change from the oldest snapshot to the newest one, or the number that the replayed run measured."""
    if record.recorded is not None:
        return record.recorded_number("parameter_change")
    return relative_change(history[0], history[-1])


def relative_change(before: Tensor, after: Tensor) -> float:
    """Eq. 3 as a fraction: ``||after - before||_2 / ||before||_2``, summed in float64."""
    before, after = before.to("cpu", torch.float64), after.to("cpu", torch.float64)
    return float(torch.linalg.vector_norm(after - before) / torch.linalg.vector_norm(before))
