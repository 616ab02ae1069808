"""The best weights of a run, kept as ``checkpoints/best``.

With evaluations during training (``evaluation.every_steps``) they are those with the best one: the mean over tasks of
(agent's mean - random policy's mean) / max(1, standard deviation of the random policy). Without, they are those of the
checkpoint with the largest rise of training returns: the mean over tasks of (mean of the newest 20 - mean of the first
20) / max(1, standard deviation of the first 20), once every task has 20 episodes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from switchmt_snn.acting.evaluation import Evaluation
from switchmt_snn.config import EvaluationConfig
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.spiking.network import QNetwork

WINDOW_EPISODES = 20
"""Episodes whose mean return is compared with that of a task's first ones."""


class BestWeights:
    """Decides whether a run's current weights are its best so far, and keeps them."""

    def __init__(self, folder: RunFolder, settings: EvaluationConfig, tasks: tuple[str, ...]) -> None:
        self.folder, self.settings, self.tasks = folder, settings, tasks

    def at_checkpoint(self, step: int, network: Callable[[], QNetwork]) -> None:
        """Judge by training returns, if nothing better will be known; ``network`` makes what would be evaluated."""
        if self.settings.every_steps is None:
            rise = rise_of_returns(self.folder.initial_and_recent_returns(WINDOW_EPISODES), self.tasks)
            if rise is not None:
                self._offer(step, network, rise, "returns")

    def at_evaluation(self, evaluation: Evaluation, network: QNetwork) -> None:
        """Judge by an evaluation of the network under the protocol of those during training."""
        if self.settings.every_steps is not None and evaluation.protocol.seed == self.settings.seed:
            self._offer(evaluation.step, lambda: network, rise_above_random(evaluation), "evaluation")

    def _offer(self, step: int, network: Callable[[], QNetwork], score: float, judged_by: str) -> None:
        store = self.folder.checkpoints()
        best = store.best()
        if best is None or best.judged_by != judged_by or score > best.score:
            store.save_best(step, network().state_dict(), score, judged_by)


def rise_of_returns(returns: dict[str, tuple[list[float], list[float]]], tasks: tuple[str, ...]) -> float | None:
    """Mean over tasks of (newest returns - first returns) / spread of the first; None while episodes are few.

    Args:
        returns: first and newest training returns by task.
        tasks: all tasks of the run.
    """
    rises = []
    for name in tasks:
        first, newest = returns.get(name, ([], []))
        if len(first) < WINDOW_EPISODES:
            return None
        rises.append((np.mean(newest) - np.mean(first)) / max(1.0, float(np.std(first))))
    return float(np.mean(rises))


def rise_above_random(evaluation: Evaluation) -> float:
    """Mean over tasks of (agent's mean - random policy's mean) / max(1, standard deviation of the random policy)."""
    rises = []
    for name in dict.fromkeys(row.task for row in evaluation.tasks):
        random = [one.score for one in evaluation.episodes if one.policy == "random" and one.task == name]
        rises.append((evaluation.score(name).mean - np.mean(random)) / max(1.0, float(np.std(random))))
    return float(np.mean(rises))
