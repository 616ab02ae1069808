"""The returns no longer rise."""

from __future__ import annotations

import math

import numpy as np

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.criterion import Criterion, Deciding, EpisodeRecord, Verdict, register_criterion


@register_criterion("reward_plateau")
class RewardPlateau(Criterion):
    """Leave when the returns of the visit no longer rise.

    A least-squares line through the newest returns rises if its slope is at least ``plateau_t`` standard errors. Only
    ``plateau_patience_episodes`` episode ends in a row without a rise make a plateau (hysteresis).
    """

    columns = ("returns", "reward_slope", "reward_t", "plateau_t", "flat_episodes")
    deciding = (Deciding("reward_t", ("plateau_t",)),)
    SAVED = ("returns", "flat_episodes")
    DERIVED = ("window_episodes", "t_threshold", "patience_episodes")

    def __init__(self, config: SwitchingConfig) -> None:
        self.window_episodes = config.plateau_window_episodes
        self.t_threshold = config.plateau_t
        self.patience_episodes = config.plateau_patience_episodes
        self.start_visit()

    def start_visit(self) -> None:
        """Forget the returns."""
        self.returns: list[float] = []
        self.flat_episodes = 0

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Test the slope of the newest returns."""
        self.returns = [*self.returns, record.episode_return][-self.window_episodes :]
        if len(self.returns) < self.window_episodes:
            return Verdict(False, "window_fills", {"returns": float(len(self.returns))})
        slope, t = slope_test(self.returns)
        self.flat_episodes = self.flat_episodes + 1 if t < self.t_threshold else 0
        measured = {
            "reward_slope": slope,
            "reward_t": t,
            "plateau_t": self.t_threshold,
            "flat_episodes": float(self.flat_episodes),
        }
        summary = f"return slope {t:.2f} of {self.t_threshold:.2f} s.e."
        return Verdict(self.flat_episodes >= self.patience_episodes, "reward_plateau", measured, summary)


def slope_test(values: list[float]) -> tuple[float, float]:
    """Least-squares slope per episode and its t statistic (slope over its standard error).

    Returns on an exact line give +-inf, constant ones 0.
    """
    y = np.asarray(values, np.float64)
    x = np.arange(len(y)) - (len(y) - 1) / 2
    spread = float((x * x).sum())
    slope = float((x * y).sum()) / spread
    residual = y - y.mean() - slope * x
    error = math.sqrt(float((residual * residual).sum()) / (len(y) - 2) / spread)
    if error <= 1e-12 * max(1.0, float(np.abs(y).max())):
        return (0.0, 0.0) if math.isclose(slope, 0.0, abs_tol=1e-12) else (slope, math.copysign(math.inf, slope))
    return slope, slope / error
