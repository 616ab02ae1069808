"""MinAtar games: 10x10 binary channels, six actions in every game; they learn in minutes on a CPU."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from switchmt_snn.config import TasksConfig, resolved_frame_stack
from switchmt_snn.config.suites import SUITE_DEFAULTS
from switchmt_snn.errors import MissingExtraError
from switchmt_snn.tasks.gym_copies import Env, GymCopies, GymCopy
from switchmt_snn.tasks.gym_spaces import channels_last
from switchmt_snn.tasks.suite import Suite, TaskSuite

GAMES = ("asterix", "breakout", "freeway", "seaquest", "space_invaders")
ACTION_NAMES = ("NOOP", "LEFT", "UP", "RIGHT", "DOWN", "FIRE")
SIDE_CELLS = 10


class MinAtarSuite(Suite):
    """MinAtar games by name (``breakout``); channels are padded with zeros to the game that has most."""

    name = "minatar"
    defaults = SUITE_DEFAULTS["minatar"]
    examples = ("breakout", "asterix")
    packages = ("minatar", "gymnasium")
    process_bytes = 120 * 1024**2  # MinAtar imports Matplotlib and seaborn
    masks_actions = True

    @classmethod
    def known_tasks(cls) -> tuple[str, ...]:
        """The five games."""
        return GAMES

    @property
    def protocol(self) -> tuple[str, ...]:
        """Actions, sticky actions and the longest episode."""
        config = self.config
        actions = "minimal actions" if config.minimal_action_mask else "all 6 actions"
        return (
            actions,
            f"sticky actions {config.sticky_action_probability:g}",
            f"frame cap {config.max_episode_frames:,}",
        )

    def make(self) -> TaskSuite:
        """Make the games.

        Raises:
            MissingExtraError: MinAtar is not installed.
        """
        config = self.config
        games: list[Any] = [_make_env(name, config).unwrapped for name in config.names]
        channels = max(int(game.observation_space.shape[2]) for game in games)
        frame_shape = (channels, SIDE_CELLS, SIDE_CELLS)
        valid_actions_KA = np.ones((len(games), len(ACTION_NAMES)), np.bool_)
        if config.minimal_action_mask:
            every = np.arange(len(ACTION_NAMES))
            valid_actions_KA = np.stack([np.isin(every, game.game.minimal_action_set()) for game in games])

        def make(task: int, num_envs: int) -> GymCopies:
            name = config.names[task]
            return GymCopies(
                [
                    GymCopy(
                        name, _make_env(name, config), frame_shape, np.uint8, channels_last, _forget_previous_action
                    )
                    for _ in range(num_envs)
                ]
            )

        return TaskSuite(
            names=config.names,
            frame_shape=frame_shape,
            frame_dtype=np.uint8,
            frame_stack=resolved_frame_stack(config),
            scale=1.0,
            in_unit_range=True,
            action_names=ACTION_NAMES,
            valid_actions_KA=valid_actions_KA,
            references={},
            make=make,
            thread_safe=True,
            versioned=True,
            make_pictured=make,
        )


def _make_env(game: str, config: TasksConfig) -> Env:
    try:
        from minatar.gym import BaseEnv
    except ModuleNotFoundError as error:
        raise MissingExtraError("MinAtar is not installed; run: pip install 'switchmt-snn[minatar]'") from error
    env = BaseEnv(game, render_mode="rgb_array", sticky_action_prob=config.sticky_action_probability)
    return gymnasium.wrappers.TimeLimit(env, max_episode_steps=config.max_episode_frames)


def _forget_previous_action(env: Any) -> None:
    """MinAtar's reset keeps the last action, which sticky actions would repeat into the new episode."""
    env.unwrapped.game.last_action = 0
