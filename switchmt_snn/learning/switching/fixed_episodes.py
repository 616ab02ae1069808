"""A fixed number of episodes per visit."""

from __future__ import annotations

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.criterion import Criterion, Deciding, EpisodeRecord, Verdict, register_criterion


@register_criterion("fixed_episodes")
class FixedEpisodes(Criterion):
    """Leave after a number of episodes (MTSpark and the baselines: 25)."""

    columns = ("visit_episodes",)
    deciding = (Deciding("episodes_in_visit", ("visit_episodes",)),)
    judges_learning = False
    DERIVED = ("episodes",)

    def __init__(self, config: SwitchingConfig) -> None:
        self.episodes = config.visit_episodes

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Count episodes."""
        leave = record.episodes_in_visit >= self.episodes
        summary = f"episode {record.episodes_in_visit} of {self.episodes}"
        return Verdict(leave, "visit_episodes", {"visit_episodes": float(self.episodes)}, summary)
