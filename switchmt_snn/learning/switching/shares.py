"""Steps divided among tasks by shares that change: which task is owed most."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.state import Stateful
from switchmt_snn.learning.switching.criterion import Deciding, Verdict
from switchmt_snn.tasks.suite import Reference

COLUMNS = ("share", "owed_steps", "most_owed_steps", "steps_since_choice", "visit_steps")
"""What a policy by shares reports of them."""
DECIDING = Deciding("owed_steps", ("most_owed_steps",))
"""It leaves a task for the one that is owed more."""


class Shares(Stateful):
    """Keeps the steps of K tasks near shares, without random numbers: the task that is owed most is played next.

    With every step that is played, each task is owed its share of it, and the task that is played has been paid a whole
    one. So the steps follow the shares as draws in proportion to them would on average, episodes of any length
    included, and the same records give the same choices.

    Attributes:
        owed_steps: by task; their sum is 0 as long as none is at the bound, K times the longest visit (or
            ``visit_steps``, if that is more). Beyond it debts are dropped: a bound of the policy forbids to pay them.
        steps_by_task: all steps that were played.
        longest_steps: the longest visit, or ``visit_steps``.
    """

    SAVED = ("owed_steps", "steps_by_task", "longest_steps", "counted_steps", "chosen_at_steps")
    DERIVED = ("visit_steps", "uniform_share")

    def __init__(self, config: SwitchingConfig, num_tasks: int) -> None:
        self.visit_steps = config.visit_steps
        self.uniform_share = config.uniform_share
        self.owed_steps = [0.0] * num_tasks
        self.steps_by_task = [0] * num_tasks
        self.longest_steps = config.visit_steps
        self.start_visit()

    def start_visit(self) -> None:
        """A visit begins; debts stay."""
        self.counted_steps = 0
        self.chosen_at_steps = 0

    def mixed(self, wanted_K: npt.NDArray[np.float64]) -> list[float]:
        """Shares that sum to 1 of weights that are at least 0, with the equal part of ``uniform_share``."""
        total, equal = float(wanted_K.sum()), 1.0 / len(wanted_K)
        weights = wanted_K / total if total > 0 else np.full(len(wanted_K), equal)
        return [float(self.uniform_share * equal + (1.0 - self.uniform_share) * weight) for weight in weights]

    def pay(self, task: int, steps_in_visit: int, shares: list[float]) -> None:
        """Count the steps of the visit that are new."""
        played = steps_in_visit - self.counted_steps
        self.counted_steps = steps_in_visit
        self.steps_by_task[task] += played
        self.longest_steps = max(self.longest_steps, steps_in_visit)
        bound = len(shares) * self.longest_steps
        for other, share in enumerate(shares):
            owed = self.owed_steps[other] + share * played - (played if other == task else 0)
            self.owed_steps[other] = min(max(owed, -bound), bound)

    def most_owed(self, other_than: int | None = None) -> int:
        """The task that is owed most; the first of several."""
        tasks = [task for task in range(len(self.owed_steps)) if task != other_than]
        return max(tasks, key=lambda task: self.owed_steps[task])

    def verdict(self, task: int, shares: list[float], reason: str, measured: dict[str, float], name: str) -> Verdict:
        """Leave if ``visit_steps`` passed since the last choice, and another task is owed more."""
        best = self.most_owed()
        since = self.counted_steps - self.chosen_at_steps
        measured = measured | {
            "share": shares[task],
            "owed_steps": self.owed_steps[task],
            "most_owed_steps": self.owed_steps[best],
            "steps_since_choice": float(since),
            "visit_steps": float(self.visit_steps),
        }
        if since < self.visit_steps:
            return Verdict(False, "visit_steps", measured, f"{name}, step {since} of {self.visit_steps}")
        leave = self.owed_steps[best] > self.owed_steps[task]
        if not leave:
            self.chosen_at_steps = self.counted_steps
        return Verdict(leave, reason if leave else "chosen_again", measured, f"{name}, share {shares[task]:.0%}")


def score_ranges(
    config: SwitchingConfig, num_tasks: int, references: tuple[Reference | None, ...]
) -> list[tuple[float, float] | None]:
    """Floor and reference score of each task, from the settings or else published; None where there is no reference.

    Raises:
        ConfigError: not one score per task, or a reference that is not above its floor.
    """
    for key in ("reference_scores", "floor_scores"):
        given = getattr(config, key)
        if given and len(given) != num_tasks:
            raise ConfigError(
                f"switching.{key} has {len(given)} scores, expected {num_tasks}, one for each task in order"
            )
    ranges: list[tuple[float, float] | None] = []
    for task, published in enumerate(references):
        if not config.reference_scores and published is None:
            ranges.append(None)
            continue
        reference = config.reference_scores[task] if config.reference_scores else published.human  # type: ignore[union-attr]
        floor = config.floor_scores[task] if config.floor_scores else 0.0 if published is None else published.random
        if reference <= floor:
            raise ConfigError(
                f"task {task} has the reference score {reference:g} and the floor {floor:g}, expected a reference "
                "above the floor; set switching.reference_scores and switching.floor_scores (what random play scores)"
            )
        ranges.append((float(floor), float(reference)))
    return ranges
