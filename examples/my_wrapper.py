"""A wrapper of one's own, for environments with continuous actions: ``tasks.wrappers: ["my_wrapper:OneAxis"]``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np


class OneAxis(gymnasium.ActionWrapper[Any, int, np.ndarray]):
    """A Box of n numbers as 2 n + 1 actions: 0 leaves all alone; each other one sets one number to an end of its range.

    Action 2 i + 1 sets number i to its lowest value, action 2 i + 2 to its highest; the others are 0, or the nearest
    value that they may have.
    """

    def __init__(self, env: gymnasium.Env[Any, np.ndarray]) -> None:
        """Wrap an environment with a bounded Box of actions."""
        super().__init__(env)
        space = env.action_space
        if not (isinstance(space, gymnasium.spaces.Box) and space.is_bounded()):
            raise TypeError(f"the action space is {space}, expected a Box with finite bounds")
        rest = np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
        self._choices = [rest]
        for axis in range(rest.size):
            for end in (space.low, space.high):
                choice = rest.copy()
                choice.flat[axis] = end.flat[axis]
                self._choices.append(choice)
        self.action_space = gymnasium.spaces.Discrete(len(self._choices))

    def action(self, action: int) -> np.ndarray:
        """The numbers that an action stands for."""
        return self._choices[action]
