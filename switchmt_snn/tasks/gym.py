"""Any Gymnasium environments with discrete actions and image or vector observations, padded to one shape."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from switchmt_snn.config import resolved_frame_stack
from switchmt_snn.config.plugins import failure, import_plugin_module
from switchmt_snn.config.suites import SUITE_DEFAULTS
from switchmt_snn.errors import TaskError, did_you_mean
from switchmt_snn.tasks.suite import Frames, Suite, TaskEnvironment, TaskSuite, VectorStep

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
            self._place(frames[row], observation, env)
        return frames

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Step every copy."""
        n = self.num_envs
        frames = np.zeros((n, *self._shape), self._dtype)
        rewards, terminated, truncated = np.zeros(n), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        for i, env in enumerate(self._envs):
            observation, reward, terminated[i], truncated[i], _ = env.step(int(actions[i]) + self._first_action)
            rewards[i] = float(reward)
            self._place(frames[i], observation, env)
        return VectorStep(frames, rewards, terminated, truncated)

    def _place(self, target: npt.NDArray[Any], observation: Any, env: Env) -> None:
        declared = env.observation_space.shape
        if np.shape(observation) != declared:
            raise TaskError(
                f"the environment {env.unwrapped!r} gave an observation of shape {np.shape(observation)}, expected "
                f"{declared}, the shape of its observation_space"
            )
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


class GymSuite(Suite):
    """Gymnasium ids; ``my_module:MyEnv-v0`` imports ``my_module``, which registers the id, first."""

    name = "gym"
    defaults = SUITE_DEFAULTS["gym"]
    examples = ("CartPole-v1", "Acrobot-v1")
    open_names = True
    packages = ("gymnasium",)

    @classmethod
    def known_tasks(cls) -> tuple[str, ...]:
        """Ids that are registered now."""
        return tuple(gymnasium.registry)

    @property
    def files(self) -> dict[str, Path]:
        """The modules that tasks name before a colon."""
        modules = dict.fromkeys(name.split(":")[0] for name in self.config.names if ":" in name)
        return {module: Path(inspect.getfile(import_plugin_module(module))) for module in modules}

    def make(self) -> TaskSuite:
        """Make the environments.

        Raises:
            TaskError: an id is unknown or cannot be made, actions are not discrete, observations are not boxes of one
                to three dimensions, or images and vectors are mixed.
        """
        names = self.config.names
        probes = [_make_env(name) for name in names]
        counts = [_num_actions(name, env) for name, env in zip(names, probes, strict=True)]
        shapes = [_frame_shape(name, env) for name, env in zip(names, probes, strict=True)]
        images = {len(shape) == 3 for shape in shapes}
        if len(images) > 1:
            raise TaskError(f"tasks {', '.join(names)} mix images and vectors, expected one kind in one network")
        is_image = images.pop()
        if is_image and not all(env.observation_space.dtype == np.uint8 for env in probes):
            raise TaskError("image tasks must have uint8 observations; wrap the environment to return bytes")
        for env in probes:
            env.close()
        frame_shape = tuple(int(side) for side in np.max(np.asarray(shapes), axis=0))
        dtype: npt.DTypeLike = np.uint8 if is_image else np.float32
        num_actions = max(counts)

        def make(task: int, num_envs: int) -> TaskEnvironment:
            envs = [_make_env(names[task]) for _ in range(num_envs)]
            return GymCopies(envs, frame_shape, dtype, channels_first)

        return TaskSuite(
            names=names,
            frame_shape=frame_shape,
            frame_dtype=dtype,
            frame_stack=resolved_frame_stack(self.config),
            scale=1.0 / 255.0 if is_image else 1.0,
            in_unit_range=is_image,
            action_names=tuple(f"action_{a}" for a in range(num_actions)),
            valid_actions_KA=np.arange(num_actions)[None, :] < np.asarray(counts)[:, None],
            references={},
            make=make,
        )


def _num_actions(name: str, env: Env) -> int:
    actions = env.action_space
    if not isinstance(actions, gymnasium.spaces.Discrete):
        raise TaskError(f"task {name!r} has the action space {actions}, expected Discrete: a Q-network lists actions")
    return int(actions.n)


def _frame_shape(name: str, env: Env) -> tuple[int, ...]:
    space = env.observation_space
    if not (isinstance(space, gymnasium.spaces.Box) and 1 <= len(space.shape) <= 3):
        raise TaskError(f"task {name!r} observes {space}, expected a Box of an image or a vector")
    return channels_first(np.zeros(space.shape, space.dtype)).shape


def _make_env(name: str) -> Env:
    """The environment ``EnvId``, or ``module:EnvId`` after importing the module, as Gymnasium does."""
    module, colon, env_id = name.partition(":")
    if colon:
        try:
            import_plugin_module(module)
        except ImportError as error:
            raise TaskError(
                f"tasks.names has {name!r}, expected an importable module before the colon, but importing {module!r} "
                f"fails ({error}); install it, or add its folder to PYTHONPATH"
            ) from error
    try:
        return gymnasium.make(env_id if colon else name)
    except gymnasium.error.DependencyNotInstalled as error:
        raise TaskError(f"task {name!r} needs a package that is not installed ({error})") from error
    except ImportError as error:
        raise TaskError(f"task {name!r} cannot be made ({error}), expected all its packages; install them") from error
    except gymnasium.error.UnregisteredEnv as error:
        raise TaskError(f"tasks.names has the unknown Gymnasium id {name!r}{_hint(name)}") from error
    except Exception as error:  # whatever the environment's own code raises
        raise TaskError(
            f"task {name!r} cannot be made ({failure(error)}), expected a Gymnasium environment with observation_space "
            "and action_space"
        ) from error


def _hint(name: str) -> str:
    """Near ids: after ``module:``, of those whose class lies in the module."""
    module, colon, _ = name.partition(":")
    if not colon:
        return did_you_mean(name, gymnasium.registry)
    own = [
        f"{module}:{env_id}"
        for env_id, spec in gymnasium.registry.items()
        if (
            spec.entry_point if isinstance(spec.entry_point, str) else getattr(spec.entry_point, "__module__", "")
        ).partition(":")[0]
        == module
    ]
    return (
        did_you_mean(name, own)
        if own
        else f"; {module!r} registers none of its classes; call gymnasium.register(id, MyEnv, max_episode_steps=...)"
    )
