"""``switchmt_snn.tasks.swapped_cartpole:SwappedCartPole-v1``: CartPole-v1 with left and right swapped.

For tasks that change midway (``tasks.later_names``): what was learned on CartPole-v1 is wrong here at once, and can be
learned again in as many steps.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.envs.classic_control.cartpole import CartPoleEnv


class SwappedCartPole(gymnasium.ActionWrapper[Any, Any, Any]):
    """Action 0 pushes to the right, 1 to the left."""

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(CartPoleEnv(render_mode=render_mode))

    def action(self, action: Any) -> Any:
        """The other action."""
        return 1 - action


if "SwappedCartPole-v1" not in gymnasium.registry:
    gymnasium.register("SwappedCartPole-v1", entry_point=f"{__name__}:SwappedCartPole", max_episode_steps=500)
