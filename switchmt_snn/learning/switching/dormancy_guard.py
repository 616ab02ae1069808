"""The same steps for every task, but a task is left early when neurons fall silent on it."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.criterion import Criterion, Deciding, EpisodeRecord, Verdict, register_criterion


@register_criterion("dormancy_guard")
class DormancyGuard(Criterion):
    """``fixed_steps`` that also leaves when a layer's share of silent neurons rose by ``silent_rise`` within the visit.

    A neuron is silent if it fires at none of the ``probe_observations`` of the task's replay, which stay fixed for the
    visit. The rise is that of the layer in which it is largest, from the visit's smallest share. ScaleZero (arXiv
    2509.07945) finds that the share of dormant units rises when several tasks are learned in one network and one of
    them collapses; to leave a task for it is ours.
    """

    columns = ("silent_share", "silent_rise", "silent_rise_bound", "visit_steps")
    deciding = (Deciding("silent_rise", ("silent_rise_bound",)),)
    judges_learning = False  # it counts steps like fixed_steps; silence is looked at once there was an update
    needs_network: ClassVar = {
        "silent_share": ("probe_observations",),
        "silent_rise": ("probe_observations",),
    }
    SAVED = ("probe", "least")
    DERIVED = ("visit_steps", "bound", "probe_observations")

    def __init__(self, config: SwitchingConfig) -> None:
        self.visit_steps = config.visit_steps
        self.bound = config.silent_rise
        self.probe_observations = config.probe_observations
        self.start_visit()

    def start_visit(self) -> None:
        """Forget the probe and its shares."""
        self.probe: Tensor | None = None
        self.least: dict[str, float] = {}

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Count the visit's steps, and, after its first update, the silent neurons."""
        measured = {"visit_steps": float(self.visit_steps)}
        summary = f"step {record.steps_in_visit} of {self.visit_steps}"
        if record.updates_in_visit > 0:
            share, rise = self._silence(record)
            measured |= {"silent_share": share, "silent_rise": rise, "silent_rise_bound": self.bound}
            summary += f", silent neurons {share:.0%}"
            if rise > self.bound:
                return Verdict(True, "neurons_fell_silent", measured, summary)
        return Verdict(record.steps_in_visit >= self.visit_steps, "visit_steps", measured, summary)

    def _silence(self, record: EpisodeRecord) -> tuple[float, float]:
        """Share and rise in the layer whose share rose most, or the numbers that the replayed run measured."""
        if record.recorded is not None:
            return record.recorded_number("silent_share"), record.recorded_number("silent_rise")
        if self.probe is None:
            self.probe = record.observations(self.probe_observations)
        shares = record.silent_shares(self.probe)
        self.least = {layer: min(share, self.least.get(layer, share)) for layer, share in shares.items()}
        layer = max(shares, key=lambda each: shares[each] - self.least[each])
        return shares[layer], shares[layer] - self.least[layer]
