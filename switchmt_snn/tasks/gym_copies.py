"""Copies of a Gymnasium environment, stepped one after the other; every observation is compared with its space."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import MissingExtraError, TaskError, shown
from switchmt_snn.tasks.randomness import OwnGenerators
from switchmt_snn.tasks.suite import Frames, Picture, VectorStep

Env = gymnasium.Env[Any, Any]


class GymCopies:
    """Copies of one Gymnasium environment stepped one after the other, their frames padded with zeros."""

    def __init__(
        self,
        name: str,
        envs: Sequence[Env],
        frame_shape: tuple[int, ...],
        frame_dtype: npt.DTypeLike,
        to_frame: Callable[[npt.NDArray[Any]], npt.NDArray[Any]],
        before_reset: Callable[[Env], None] | None = None,
    ) -> None:
        """Wrap environments.

        Args:
            name: of the task, for errors.
            envs: the copies.
            frame_shape: the suite's frame shape; frames are put at its origin.
            frame_dtype: the suite's frame type.
            to_frame: observation -> channels-first frame.
            before_reset: clears state that the environment's own reset leaves (MinAtar's previous action).
        """
        self.num_envs = len(envs)
        self._name, self._envs = name, list(envs)
        self._shape, self._dtype, self._to_frame, self._before_reset = frame_shape, frame_dtype, to_frame, before_reset
        self._first_action = first_action(envs[0])
        # Environments that are not Gymnasium's own may draw from the global generators, and from their spaces.
        self._generators = [OwnGenerators() if is_outside(env) else None for env in envs]
        self._drawing = OwnGenerators() if is_outside(envs[0]) else _NOTHING
        for env, generators in zip(envs, self._generators, strict=True):
            if generators is not None:
                _give_own_spaces(env)

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> Frames:
        """Start new episodes with the given seeds."""
        frames = np.zeros((len(env_ids), *self._shape), self._dtype)
        for row, (env_id, seed) in enumerate(zip(env_ids, seeds, strict=True)):
            env, generators = self._envs[env_id], self._generators[env_id]
            if generators is not None:
                generators.seed(int(seed))
                _seed_spaces(env, int(seed))
            if self._before_reset is not None:
                self._before_reset(env)
            with generators or _NOTHING:
                observation, _ = env.reset(seed=int(seed))
            self._place(frames[row], observation, env)
        return frames

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Step every copy."""
        n = self.num_envs
        frames = np.zeros((n, *self._shape), self._dtype)
        rewards, terminated, truncated = np.zeros(n), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        for i, env in enumerate(self._envs):
            with self._generators[i] or _NOTHING:
                observation, reward, ended, cut, _ = env.step(int(actions[i]) + self._first_action)
            rewards[i] = self._one_number("reward", reward)
            terminated[i], truncated[i] = self._truth("terminated", ended), self._truth("truncated", cut)
            self._place(frames[i], observation, env)
        return VectorStep(frames, rewards, terminated, truncated)

    def picture(self, env_id: int) -> Picture | None:
        """What a copy's ``render`` gives, as bytes; None if it was made without pictures.

        Raises:
            MissingExtraError: drawing needs a package that is not installed.
        """
        env = self._envs[env_id]
        if env.render_mode != "rgb_array":
            return None
        try:
            with self._drawing:  # what drawing takes from the global generators, the play does not miss
                picture = env.render()
        except gymnasium.error.DependencyNotInstalled as error:
            raise MissingExtraError(
                f"pictures of {self._name} need a package that is not installed ({error}); "
                "run: pip install 'switchmt-snn[video]'"
            ) from error
        array = np.asarray(picture)
        # MinAtar's colours go from 0 to 1.
        return np.rint(255 * array).astype(np.uint8) if array.dtype.kind == "f" else array

    @property
    def draws_globally(self) -> bool:
        """Whether an environment has drawn from the global generators since its last reset, or seeded them."""
        return any(generators is not None and generators.were_used for generators in self._generators)

    def close(self) -> None:
        """Close the copies."""
        for env in self._envs:
            env.close()

    def _place(self, target: npt.NDArray[Any], observation: Any, env: Env) -> None:
        """Compare an observation with its space, and write its frame."""
        space = env.observation_space
        seen = np.shape(observation)
        if seen != space.shape:
            raise TaskError(
                f"task {self._name!r} gave an observation of shape {seen}, expected {space.shape}, the shape of its "
                "observation_space"
            )
        array = np.asarray(observation)
        if not np.can_cast(array.dtype, space.dtype or np.float32, "same_kind"):
            raise TaskError(
                f"task {self._name!r} gave an observation of type {array.dtype}, expected {space.dtype}, the type of "
                "its observation_space"
            )
        frame = self._to_frame(array)
        with np.errstate(over="ignore"):  # what is no float32 becomes infinite, and is refused as such
            target[tuple(slice(0, side) for side in frame.shape)] = frame

    def _one_number(self, name: str, value: Any) -> float:
        if isinstance(value, (float, int)) or (np.ndim(value) == 0 and np.asarray(value).dtype.kind in "biuf"):
            return float(value)
        raise TaskError(f"task {self._name!r} gave {name} = {shown(value)}, expected one number")

    def _truth(self, name: str, value: Any) -> bool:
        if isinstance(value, (bool, np.bool_)) or (np.ndim(value) == 0 and value in (0, 1)):
            return bool(value)
        raise TaskError(f"task {self._name!r} gave {name} = {shown(value)}, expected True or False")


_NOTHING: contextlib.AbstractContextManager[None] = contextlib.nullcontext()


def first_action(env: Env) -> int:
    """The number by which an environment calls its first action: ``start`` of a ``Discrete`` space."""
    return int(getattr(env.action_space, "start", 0))


def is_outside(env: Env) -> bool:
    """Whether an environment, or one of its wrappers, comes from another package than Gymnasium and MinAtar."""
    layers = [env]
    while isinstance(layers[-1], gymnasium.Wrapper):
        layers.append(layers[-1].env)
    return any(type(layer).__module__.partition(".")[0] not in ("gymnasium", "minatar") for layer in layers)


def _give_own_spaces(env: Env) -> None:
    """Copies may share spaces that are attributes of their class, and with them the generator of ``sample``."""
    for name in ("action_space", "observation_space"):
        with contextlib.suppress(AttributeError):  # a property, which makes its own
            setattr(env.unwrapped, name, copy.deepcopy(getattr(env.unwrapped, name)))


def _seed_spaces(env: Env, seed: int) -> None:
    """Seed what ``sample`` draws from: an environment may call it."""
    for space in (env.unwrapped.action_space, env.unwrapped.observation_space):
        space.seed(seed)
