"""``switchmt_snn.tasks.held_mountain_car:HeldMountainCar-v0``: MountainCar-v0 with every action held for eight steps.

A task that is hard to start, but no lottery: of 300 episodes of random play none reaches the goal of MountainCar-v0,
and three that of this one, in an eighth of the agent steps. Returns are those of MountainCar-v0 (-200 without the
goal).
"""

from __future__ import annotations

from typing import Any

import gymnasium

STEPS = 8
"""Steps of MountainCar-v0 to one agent step; an episode has at most 25 of these."""


class HeldMountainCar(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An agent step is eight steps of MountainCar-v0 with one action; rewards are added up."""

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(gymnasium.make("MountainCar-v0", render_mode=render_mode))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Hold an action until eight steps or the episode are over."""
        total = 0.0
        for _ in range(STEPS):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


if "HeldMountainCar-v0" not in gymnasium.registry:
    gymnasium.register("HeldMountainCar-v0", entry_point=f"{__name__}:HeldMountainCar")
