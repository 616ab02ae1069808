"""Parameters and returns have both levelled off."""

from __future__ import annotations

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.criterion import Criterion, EpisodeRecord, Verdict, register_criterion
from switchmt_snn.learning.switching.parameter_change import ParameterChange
from switchmt_snn.learning.switching.reward_plateau import RewardPlateau


@register_criterion("parameter_and_reward")
class ParameterAndReward(Criterion):
    """The abstract's claim: leave when both the parameters and the rewards have levelled off."""

    columns = (*ParameterChange.columns, *RewardPlateau.columns, "parameter_says_leave", "reward_says_leave")
    deciding = (*ParameterChange.deciding, *RewardPlateau.deciding)
    needs_network = ParameterChange.needs_network
    SAVED = ("parameter", "reward")

    def __init__(self, config: SwitchingConfig) -> None:
        self.parameter = ParameterChange(config)
        self.reward = RewardPlateau(config)

    @classmethod
    def snapshots(cls, config: SwitchingConfig) -> int:
        """Those of Eq. 3."""
        return ParameterChange.snapshots(config)

    def start_visit(self) -> None:
        """Forget both."""
        self.parameter.start_visit()
        self.reward.start_visit()

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Ask both criteria."""
        parameter, reward = self.parameter.end_of_episode(record), self.reward.end_of_episode(record)
        measured = parameter.measured | reward.measured
        measured |= {"parameter_says_leave": float(parameter.leave), "reward_says_leave": float(reward.leave)}
        summary = "; ".join(verdict.summary or verdict.reason.replace("_", " ") for verdict in (parameter, reward))
        return Verdict(parameter.leave and reward.leave, "parameter_and_reward", measured, summary)
