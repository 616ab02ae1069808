"""Eq. 3 per gradient step, relative to the visit's largest."""

from __future__ import annotations

from torch import Tensor

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.criterion import Criterion, Deciding, EpisodeRecord, Verdict, register_criterion
from switchmt_snn.learning.switching.parameter_change import ParameterChange, append_snapshot, change_over


@register_criterion("parameter_change_per_update")
class ParameterChangePerUpdate(Criterion):
    """Leave when the relative change per gradient step has fallen to a fraction of the visit's largest.

    Eq. 3 grows with the number of updates in K episodes. This criterion does not depend on the length of episodes or on
    the learning rate.
    """

    columns = (
        "parameter_change",
        "snapshots",
        "updates_in_window",
        "change_per_update",
        "largest_change_per_update",
        "change_rate_fraction",
    )
    deciding = (Deciding("change_per_update", ("change_rate_fraction", "largest_change_per_update")),)
    needs_network = ParameterChange.needs_network
    SAVED = ("history", "updates", "largest")
    DERIVED = ("window_episodes", "fraction")

    def __init__(self, config: SwitchingConfig) -> None:
        self.window_episodes = config.window_episodes
        self.fraction = config.change_rate_fraction
        self.start_visit()

    @classmethod
    def snapshots(cls, config: SwitchingConfig) -> int:
        """K + 1, and the newest one before the oldest one is dropped."""
        return config.window_episodes + 2

    def start_visit(self) -> None:
        """Forget the snapshots and the largest rate."""
        self.history: list[Tensor] = []
        self.updates: list[int] = []
        self.largest = 0.0

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Measure the change per update over K episodes."""
        append_snapshot(self.history, record)
        self.updates.append(record.updates)
        if len(self.updates) <= self.window_episodes:
            return Verdict(False, "window_fills", {"snapshots": float(len(self.updates))})
        del self.history[: len(self.history) - self.window_episodes - 1]
        del self.updates[: len(self.updates) - self.window_episodes - 1]
        change, updates = change_over(self.history, record), self.updates[-1] - self.updates[0]
        measured = {"parameter_change": change, "updates_in_window": float(updates)}
        if updates == 0:
            return Verdict(False, "no_updates_yet", measured)
        rate = change / updates
        self.largest = max(self.largest, rate)
        measured |= {"change_per_update": rate, "largest_change_per_update": self.largest}
        measured["change_rate_fraction"] = self.fraction
        bound = self.fraction * self.largest
        return Verdict(rate < bound, "change_per_update", measured, f"change per update {rate:.2e} of {bound:.2e}")
