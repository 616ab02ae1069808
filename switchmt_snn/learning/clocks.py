"""Clocks: "every n steps", however many steps pass at once; they survive resume and vectorised environments."""

from __future__ import annotations

from switchmt_snn.learning.state import Stateful


class Every(Stateful):
    """Counts steps and says how often a period has come round."""

    SAVED = ("waited_steps",)
    DERIVED = ("period_steps",)

    def __init__(self, period_steps: int) -> None:
        self.period_steps = period_steps
        self.waited_steps = 0

    def advance(self, steps: int) -> int:
        """Let steps pass; returns how many periods ended within them."""
        rounds, self.waited_steps = divmod(self.waited_steps + steps, self.period_steps)
        return rounds


def linear_decay(start: float, end: float, duration_steps: int, step: int) -> float:
    """Value at a step of a straight line from start (step 0) to end (``duration_steps``), constant after it."""
    return start + (end - start) * min(1.0, step / duration_steps)
