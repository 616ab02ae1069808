"""A fixed number of steps per visit."""

from __future__ import annotations

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.criterion import Criterion, Deciding, EpisodeRecord, Verdict, register_criterion


@register_criterion("fixed_steps")
class FixedSteps(Criterion):
    """Leave at the first episode end after a number of steps."""

    columns = ("visit_steps",)
    deciding = (Deciding("steps_in_visit", ("visit_steps",)),)
    judges_learning = False
    DERIVED = ("steps",)

    def __init__(self, config: SwitchingConfig) -> None:
        self.steps = config.visit_steps

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Count steps."""
        leave = record.steps_in_visit >= self.steps
        summary = f"step {record.steps_in_visit} of {self.steps}"
        return Verdict(leave, "visit_steps", {"visit_steps": float(self.steps)}, summary)
