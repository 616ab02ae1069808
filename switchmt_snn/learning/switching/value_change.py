"""Eq. 3 repaired: the change of Q-values, not of parameters, per gradient step."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.criterion import Criterion, Deciding, EpisodeRecord, Verdict, register_criterion


@register_criterion("value_change")
class ValueChange(Criterion):
    """Leave when the change of Q per gradient step has fallen to a fraction of the visit's largest.

    ``mean |Q_t - Q_(t-K)| / updates`` on a batch of observations that stays fixed for the visit. Parameters may move
    without any effect on the values (Eq. 3 sees this as learning), and they move with the number of updates; this does
    neither. Noise of Q counts as change, so a visit's rate never falls to 0.
    """

    columns = (
        "value_change",
        "updates_in_window",
        "value_change_per_update",
        "largest_value_change_per_update",
        "change_rate_fraction",
    )
    deciding = (Deciding("value_change_per_update", ("change_rate_fraction", "largest_value_change_per_update")),)
    needs_network: ClassVar = {"value_change": ("window_episodes", "probe_observations")}
    SAVED = ("probe", "values", "updates", "largest")
    DERIVED = ("window_episodes", "fraction", "probe_observations")

    def __init__(self, config: SwitchingConfig) -> None:
        self.window_episodes = config.window_episodes
        self.fraction = config.change_rate_fraction
        self.probe_observations = config.probe_observations
        self.start_visit()

    def start_visit(self) -> None:
        """Forget the probe and what was measured on it."""
        self.probe: Tensor | None = None
        self.values: list[Tensor] = []
        self.updates: list[int] = []
        self.largest = 0.0

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Ask for Q on the probe, and compare it with Q before K episodes."""
        if record.recorded is None:
            if self.probe is None:
                self.probe = record.observations(self.probe_observations)
            self.values.append(record.values(self.probe))
        self.updates.append(record.updates)
        if len(self.updates) <= self.window_episodes:
            return Verdict(False, "window_fills", {})
        for history in (self.values, self.updates):
            del history[: len(history) - self.window_episodes - 1]
        change = self._change(record)
        updates = self.updates[-1] - self.updates[0]
        measured = {"value_change": change, "updates_in_window": float(updates)}
        if updates == 0:
            return Verdict(False, "no_updates_in_window", measured)
        rate = change / updates
        self.largest = max(self.largest, rate)
        measured |= {"value_change_per_update": rate, "largest_value_change_per_update": self.largest}
        measured["change_rate_fraction"] = self.fraction
        bound = self.fraction * self.largest
        return Verdict(rate < bound, "value_change", measured, f"change of Q per update {rate:.2e} of {bound:.2e}")

    def _change(self, record: EpisodeRecord) -> float:
        """Mean absolute change of Q over the window, or the number that the replayed run measured."""
        if record.recorded is not None:
            return record.recorded_number("value_change")
        return float(torch.mean(torch.abs(self.values[-1].double() - self.values[0].double())))
