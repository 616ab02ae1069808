"""MinAtar games: 10x10 binary channels, six actions in every game; they learn in minutes on a CPU."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from switchmt_snn.config import TasksConfig
from switchmt_snn.errors import MissingExtraError, TaskError, did_you_mean
from switchmt_snn.tasks.gym import Env, GymCopies, channels_first
from switchmt_snn.tasks.suite import TaskEnvironment, TaskSuite

GAMES = ("asterix", "breakout", "freeway", "seaquest", "space_invaders")
ACTION_NAMES = ("NOOP", "LEFT", "UP", "RIGHT", "DOWN", "FIRE")
SIDE_CELLS = 10


def make_minatar_suite(config: TasksConfig) -> TaskSuite:
    """Suite of MinAtar games; channels are padded with zeros to the game that has most.

    Raises:
        TaskError: unknown game.
        MissingExtraError: MinAtar is not installed.
    """
    for name in config.names:
        if name not in GAMES:
            raise TaskError(f"tasks.names has the unknown MinAtar game {name!r}{did_you_mean(name, GAMES)}")
    try:
        from minatar.gym import BaseEnv
    except ModuleNotFoundError as error:
        raise MissingExtraError("MinAtar is not installed; run: pip install 'switchmt-snn[minatar]'") from error

    def make_env(name: str) -> Env:
        game = BaseEnv(name, sticky_action_prob=config.sticky_action_probability)
        return gymnasium.wrappers.TimeLimit(game, max_episode_steps=config.max_episode_frames)

    channels = max(int(make_env(name).unwrapped.observation_space.shape[2]) for name in config.names)  # type: ignore[index]
    frame_shape = (channels, SIDE_CELLS, SIDE_CELLS)

    def make(task: int, num_envs: int) -> TaskEnvironment:
        envs = [make_env(config.names[task]) for _ in range(num_envs)]
        return GymCopies(envs, frame_shape, np.uint8, channels_first, before_reset=_forget_previous_action)

    return TaskSuite(
        names=config.names,
        frame_shape=frame_shape,
        frame_dtype=np.uint8,
        frame_stack=config.frame_stack or 1,
        scale=1.0,
        in_unit_range=True,
        action_names=ACTION_NAMES,
        valid_actions_KA=np.ones((len(config.names), len(ACTION_NAMES)), np.bool_),
        references={},
        make=make,
    )


def _forget_previous_action(env: Any) -> None:
    """MinAtar's reset keeps the last action, which sticky actions would repeat into the new episode."""
    env.unwrapped.game.last_action = 0
