"""A switching policy of one's own, for 03_own_policy.py."""

from __future__ import annotations

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching import Criterion, EpisodeRecord, Verdict


class ReturnAbove(Criterion):
    """Leave a task once the mean of the newest returns reaches a target."""

    columns = ("mean_return", "target")  # what it measures; each becomes a column of switches.csv
    SAVED = ("returns",)  # what changes; checkpoints hold it
    DERIVED = ("target", "window")  # what the constructor sets

    def __init__(self, config: SwitchingConfig, target: float = 60.0, window: int = 5) -> None:
        self.target = target
        self.window = window
        self.returns: list[float] = []

    def start_visit(self) -> None:
        """Forget the returns of the last visit."""
        self.returns = []

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Leave if the newest ``window`` returns are good enough."""
        self.returns = [*self.returns, record.episode_return][-self.window :]
        mean = sum(self.returns) / len(self.returns)
        measured = {"mean_return": mean, "target": self.target}
        leave = len(self.returns) == self.window and mean >= self.target
        return Verdict(leave, "return_above", measured, summary=f"return {mean:.1f} of {self.target:.1f}")
