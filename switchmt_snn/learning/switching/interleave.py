"""A switch at every episode end."""

from __future__ import annotations

from switchmt_snn.learning.switching.criterion import Criterion, EpisodeRecord, Verdict, register_criterion


@register_criterion("interleave")
class Interleave(Criterion):
    """Leave after every episode: the tasks take turns."""

    columns = ()
    judges_learning = False

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Leave, whatever happened."""
        return Verdict(True, "interleave", {})
