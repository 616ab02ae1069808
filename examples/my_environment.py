"""Two Gymnasium tasks of one's own, for 02_own_environment.py: importing this module registers their ids."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np


class Follow(gymnasium.Env[np.ndarray, int]):
    """A target moves on a line; the player steps left, stays, or steps right. +1 for every step close to the target.

    An episode is a function of its seed and the actions, since all chance comes from ``self.np_random``. So runs resume
    exactly.
    """

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(3)

    def __init__(self, speed: float) -> None:
        self.speed = speed

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Both start anywhere."""
        super().reset(seed=seed)
        self.player, self.target = self.np_random.uniform(-1.0, 1.0, 2)
        self.direction = self.np_random.choice([-1.0, 1.0])
        return self._observation(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move the target, which turns at the ends, and the player."""
        self.target += self.direction * self.speed
        if abs(self.target) > 1.0:
            self.direction = -self.direction
            self.target = float(np.clip(self.target, -1.0, 1.0))
        self.player = float(np.clip(self.player + 0.15 * (int(action) - 1), -1.0, 1.0))
        reward = 1.0 if abs(self.player - self.target) < 0.15 else 0.0
        return self._observation(), reward, False, False, {}

    def _observation(self) -> np.ndarray:
        return np.array([self.player, self.target], np.float32)


gymnasium.register("Follow-v0", entry_point=Follow, kwargs={"speed": 0.05}, max_episode_steps=40)
gymnasium.register("FollowFast-v0", entry_point=Follow, kwargs={"speed": 0.12}, max_episode_steps=40)
