"""Any Gymnasium environments with discrete actions and image or vector observations, padded to one shape."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from switchmt_snn.config import TasksConfig
from switchmt_snn.errors import TaskError, did_you_mean
from switchmt_snn.tasks.suite import Frames, TaskEnvironment, TaskSuite, VectorStep

Env = gymnasium.Env[Any, Any]


class GymCopies:
    """Copies of one Gymnasium environment stepped one after the other, their frames padded with zeros."""

    def __init__(
        self,
        envs: Sequence[Env],
        frame_shape: tuple[int, ...],
        frame_dtype: npt.DTypeLike,
        to_frame: Callable[[Any], npt.NDArray[Any]],
        before_reset: Callable[[Env], None] | None = None,
    ) -> None:
        """Wrap environments.

        Args:
            envs: the copies.
            frame_shape: the suite's frame shape; frames are put at its origin.
            frame_dtype: the suite's frame type.
            to_frame: observation -> channels-first frame.
            before_reset: clears state that the environment's own reset leaves (MinAtar's previous action).
        """
        self.num_envs = len(envs)
        self._envs = list(envs)
        self._shape, self._dtype, self._to_frame, self._before_reset = frame_shape, frame_dtype, to_frame, before_reset
        starts = [getattr(env.action_space, "start", 0) for env in envs]
        self._first_action = int(starts[0])

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> Frames:
        """Start new episodes with the given seeds."""
        frames = np.zeros((len(env_ids), *self._shape), self._dtype)
        for row, (env_id, seed) in enumerate(zip(env_ids, seeds, strict=True)):
            env = self._envs[env_id]
            if self._before_reset is not None:
                self._before_reset(env)
            observation, _ = env.reset(seed=int(seed))
            self._place(frames[row], observation)
        return frames

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Step every copy."""
        n = self.num_envs
        frames = np.zeros((n, *self._shape), self._dtype)
        rewards, terminated, truncated = np.zeros(n), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        for i, env in enumerate(self._envs):
            observation, reward, terminated[i], truncated[i], _ = env.step(int(actions[i]) + self._first_action)
            rewards[i] = float(reward)
            self._place(frames[i], observation)
        return VectorStep(frames, rewards, terminated, truncated)

    def _place(self, target: npt.NDArray[Any], observation: Any) -> None:
        frame = self._to_frame(observation)
        target[tuple(slice(0, side) for side in frame.shape)] = frame

    def close(self) -> None:
        """Close the copies."""
        for env in self._envs:
            env.close()


def channels_first(observation: Any) -> npt.NDArray[Any]:
    """``[H, W, c]`` or ``[H, W]`` image -> ``[c, H, W]``; a vector stays."""
    array = np.asarray(observation)
    if array.ndim == 3:
        return np.moveaxis(array, -1, 0)
    return array[None] if array.ndim == 2 else array


def make_gym_suite(config: TasksConfig) -> TaskSuite:
    """Suite of Gymnasium ids.

    Raises:
        TaskError: an id is unknown or cannot be made, actions are not discrete, observations are not boxes of one to
            three dimensions, or images and vectors are mixed.
    """
    probes = [_make_env(name) for name in config.names]
    shapes, counts = [], []
    for name, env in zip(config.names, probes, strict=True):
        actions, observations = env.action_space, env.observation_space
        if not isinstance(actions, gymnasium.spaces.Discrete):
            raise TaskError(
                f"task {name!r} has the action space {actions}, expected Discrete: a Q-network lists actions"
            )
        box = isinstance(observations, gymnasium.spaces.Box) and 1 <= len(observations.shape) <= 3
        if not box:
            raise TaskError(f"task {name!r} observes {observations}, expected a Box of an image or a vector")
        shapes.append(channels_first(np.zeros(observations.shape or (), observations.dtype)).shape)
        counts.append(int(actions.n))
    images = {len(shape) == 3 for shape in shapes}
    if len(images) > 1:
        raise TaskError(f"tasks {', '.join(config.names)} mix images and vectors, expected one kind in one network")
    is_image = images.pop()
    bytes_only = all(env.observation_space.dtype == np.uint8 for env in probes)
    if is_image and not bytes_only:
        raise TaskError("image tasks must have uint8 observations; wrap the environment to return bytes")
    for env in probes:
        env.close()
    frame_shape = tuple(int(side) for side in np.max(np.asarray(shapes), axis=0))
    dtype: npt.DTypeLike = np.uint8 if is_image else np.float32
    num_actions = max(counts)

    def make(task: int, num_envs: int) -> TaskEnvironment:
        envs = [_make_env(config.names[task]) for _ in range(num_envs)]
        return GymCopies(envs, frame_shape, dtype, channels_first)

    return TaskSuite(
        names=config.names,
        frame_shape=frame_shape,
        frame_dtype=dtype,
        frame_stack=config.frame_stack or 1,
        scale=1.0 / 255.0 if is_image else 1.0,
        in_unit_range=is_image,
        action_names=tuple(f"action_{a}" for a in range(num_actions)),
        valid_actions_KA=np.arange(num_actions)[None, :] < np.asarray(counts)[:, None],
        references={},
        make=make,
    )


def _make_env(name: str) -> Env:
    try:
        return gymnasium.make(name)
    except gymnasium.error.DependencyNotInstalled as error:
        raise TaskError(f"task {name!r} needs a package that is not installed ({error})") from error
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        hint = did_you_mean(name, gymnasium.registry.keys())
        raise TaskError(f"tasks.names has the unknown Gymnasium id {name!r}{hint}") from error
