"""Copies of a Gymnasium environment, stepped one after the other; every observation is compared with its space."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import MissingExtraError, TaskError, shown
from switchmt_snn.tasks.contract import gymnasium_code
from switchmt_snn.tasks.gym_spaces import LARGEST_WHOLE, RoundedObservation
from switchmt_snn.tasks.masked import FILL, has_masked_values
from switchmt_snn.tasks.randomness import OwnGenerators
from switchmt_snn.tasks.suite import Frames, Picture, VectorStep

Env = gymnasium.Env[Any, Any]


class GymCopy(gymnasium.Wrapper[Any, int, Any, Any]):
    """One copy of an environment: its observations are the suite's frames, its actions count from 0.

    Every observation is compared with the environment's own space. An environment from outside Gymnasium and MinAtar,
    and its wrappers may draw from the global generators and from their spaces; an episode is a function of its seed
    all the same.
    """

    def __init__(
        self,
        name: str,
        env: Env,
        frame_shape: tuple[int, ...],
        frame_dtype: npt.DTypeLike,
        to_frame: Callable[[npt.NDArray[Any]], npt.NDArray[Any]],
        before_reset: Callable[[Env], None] | None = None,
        outside: bool = False,
    ) -> None:
        """Wrap an environment.

        Args:
            name: of the task, for errors.
            env: the environment.
            frame_shape: the suite's frame shape; frames are put at its origin, the rest is zero.
            frame_dtype: the suite's frame type.
            to_frame: observation -> channels-first frame.
            before_reset: clears state that the environment's own reset leaves (MinAtar's previous action).
            outside: it has code from outside this package, Gymnasium and MinAtar (``is_outside``).
        """
        super().__init__(env)
        self._name, self._shape, self._dtype = name, frame_shape, np.dtype(frame_dtype)
        self._to_frame, self._before_reset = to_frame, before_reset
        self._first_action = first_action(env)
        self._generators = OwnGenerators() if outside else None
        self._drawing = OwnGenerators() if outside else _NOTHING
        self._spaces = _own_spaces(env) if outside else []
        low, high = (0, 255) if self._dtype == np.uint8 else (-np.inf, np.inf)
        self.observation_space = gymnasium.spaces.Box(low, high, frame_shape, self._dtype.type)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode; the environment's info is left out."""
        assert seed is not None, "an episode is a function of its seed"
        if self._generators is not None:
            self._generators.seed(seed)
            for space in self._spaces:
                space.seed(seed)
        if self._before_reset is not None:
            self._before_reset(self.env)
        with gymnasium_code(self._name, "reset"):
            with self._generators or _NOTHING:
                answer = self.env.reset(seed=seed)
            if not (isinstance(answer, tuple) and len(answer) == 2):
                raise TaskError(f"task {self._name!r} gave {shown(answer)} from reset, expected (observation, info)")
            return self._frame(answer[0]), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step; the environment's info is left out."""
        with gymnasium_code(self._name, "step"):  # what it returns may hold code of its own, too
            with self._generators or _NOTHING:
                observation, reward, ended, cut, _ = self.env.step(int(action) + self._first_action)
            number = self._one_number(reward)
            terminated, truncated = self._truth("terminated", ended), self._truth("truncated", cut)
            return self._frame(observation), number, terminated, truncated, {}

    def picture(self) -> Picture | None:
        """What the environment's ``render`` gives, as bytes; None if it was made without pictures.

        Raises:
            MissingExtraError: drawing needs a package that is not installed.
        """
        if self.env.render_mode != "rgb_array":
            return None
        with gymnasium_code(self._name, "picture"):
            try:
                with self._drawing:  # what drawing takes from the global generators, the play does not miss
                    picture = self.env.render()
            except gymnasium.error.DependencyNotInstalled as error:
                raise MissingExtraError(
                    f"pictures of {self._name} need a package that is not installed ({error}); "
                    "run: pip install 'switchmt-snn[video]'"
                ) from error
        array: Picture = np.asarray(picture)
        if array.dtype.kind != "f":
            return array
        low, high = array.min(initial=np.inf), array.max(initial=-np.inf)  # NaN if one value is
        if not (low >= 0 and high <= 1):  # MinAtar's colours go from 0 to 1
            raise TaskError(
                f"task {self._name!r} gave a picture of {array.dtype} from {low:g} to {high:g}, expected uint8, or "
                "numbers from 0 to 1"
            )
        return np.rint(255 * array).astype(np.uint8)

    def close(self) -> None:
        """Close the environment."""
        with gymnasium_code(self._name, "close"):
            super().close()

    @property
    def draws_globally(self) -> bool:
        """Whether the environment has drawn from the global generators since its last reset, or seeded them."""
        return self._generators is not None and self._generators.were_used

    def _frame(self, observation: Any) -> npt.NDArray[Any]:
        """Compare an observation with its space, and make its frame."""
        space = self.env.observation_space
        if has_masked_values(observation):
            raise TaskError(f"task {self._name!r} gave a masked array as observation, expected plain numbers; {FILL}")
        try:
            array = np.asarray(observation)
        except (ValueError, TypeError):  # a tuple or list of unequal lengths
            array = np.asarray(None)
        if array.dtype.kind == "O" or array.ndim == 0:
            raise TaskError(
                f"task {self._name!r} gave the {type(observation).__name__} {shown(observation)} as observation, "
                f"expected an array of shape {space.shape} and type {space.dtype}, as its observation_space says; "
                "return what it declares, or declare what it returns"
            )
        if array.shape != space.shape:
            raise TaskError(
                f"task {self._name!r} gave an observation of shape {array.shape}, expected {space.shape}, the shape of "
                "its observation_space"
            )
        # Bytes of a wider type would wrap at 256; numbers of vectors become float32.
        casting: Any = "safe" if self._dtype == np.uint8 else "same_kind"
        if not np.can_cast(array.dtype, space.dtype or np.float32, casting):
            raise TaskError(
                f"task {self._name!r} gave an observation of type {array.dtype}, expected {space.dtype}, the type of "
                "its observation_space"
            )
        frame = self._to_frame(array)
        placed = np.zeros(self._shape, self._dtype)
        with np.errstate(over="ignore"):  # what is no float32 becomes infinite, and is refused as such
            placed[tuple(slice(0, side) for side in frame.shape)] = frame
        if frame.dtype == np.float64 and LARGEST_WHOLE < np.abs(placed).max() < np.inf:
            # The same text each time: Python and our output show it once.
            warnings.warn(
                f"task {self._name!r} gives float64 observations above {LARGEST_WHOLE:,}; networks take float32, which "
                "rounds whole numbers there; scale or split them in a wrapper (tasks.wrappers)",
                RoundedObservation,
                stacklevel=1,
            )
        return placed

    def _one_number(self, reward: Any) -> float:
        if isinstance(reward, (float, int)) or (np.ndim(reward) == 0 and np.asarray(reward).dtype.kind in "biuf"):
            return float(reward)
        remedy = "mend the environment's reward"
        if np.ndim(reward) > 0:
            remedy = (
                "make it one in a wrapper (tasks.wrappers=[module:Name]): one of the environment's package, such as "
                "mo_gymnasium.wrappers:LinearReward, or a gymnasium.RewardWrapper of your own"
            )
        raise TaskError(f"task {self._name!r} gave reward = {shown(reward)}, expected one number; {remedy}")

    def _truth(self, name: str, value: Any) -> bool:
        if isinstance(value, (bool, np.bool_)) or (np.ndim(value) == 0 and value in (0, 1)):
            return bool(value)
        raise TaskError(f"task {self._name!r} gave {name} = {shown(value)}, expected True or False")


class GymCopies:
    """Copies of one Gymnasium environment, stepped one after the other."""

    def __init__(self, copies: Sequence[GymCopy]) -> None:
        self.num_envs = len(copies)
        self._copies = list(copies)

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> Frames:
        """Start new episodes with the given seeds."""
        return np.stack(
            [self._copies[env_id].reset(seed=int(seed))[0] for env_id, seed in zip(env_ids, seeds, strict=True)]
        )

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Step every copy."""
        steps = [copy.step(action) for copy, action in zip(self._copies, actions.tolist(), strict=True)]
        frames, rewards, terminated, truncated, _ = zip(*steps, strict=True)
        return VectorStep(np.stack(frames), np.asarray(rewards), np.asarray(terminated), np.asarray(truncated))

    def picture(self, env_id: int) -> Picture | None:
        """A copy as people see the game; None if it was made without pictures."""
        return self._copies[env_id].picture()

    @property
    def draws_globally(self) -> bool:
        """Whether an environment has drawn from the global generators since its last reset, or seeded them."""
        return any(copy.draws_globally for copy in self._copies)

    def close(self) -> None:
        """Close the copies."""
        for copy in self._copies:
            copy.close()


_NOTHING: contextlib.AbstractContextManager[None] = contextlib.nullcontext()


def first_action(env: Env) -> int:
    """The number by which an environment calls its first action: ``start`` of a ``Discrete`` space."""
    return int(getattr(env.action_space, "start", 0))


_INSIDE = ("gymnasium", "minatar", "switchmt_snn")


def is_outside(env: Env) -> bool:
    """Whether an environment has code that is neither of this package nor of Gymnasium or MinAtar.

    Of a class, of a wrapper, of the function that makes it, or among its arguments: a Gymnasium wrapper around a
    Gymnasium environment plays by the function that a user gave it.
    """
    if any(_of_others(type(layer)) for layer in _layers(env)):
        return True
    spec = env.unwrapped.spec
    if spec is None:
        return False
    parts = [(spec.entry_point, spec.kwargs), *((one.entry_point, one.kwargs) for one in spec.additional_wrappers)]
    return any(_of_others(made) or not _is_plain(arguments) for made, arguments in parts)


def is_inside(module: str) -> bool:
    """Whether a module is of this package, of Gymnasium or of MinAtar."""
    return module.partition(".")[0] in _INSIDE


def _of_others(made: Any) -> bool:
    """Whether a class, a function or its name, as ``package.module:Name``, is none of theirs."""
    module = made.partition(":")[0] if isinstance(made, str) else getattr(made, "__module__", "")
    return made is not None and not is_inside(module)


def _is_plain(arguments: Any) -> bool:
    """Whether arguments are numbers, text, and lists of them, and no code."""
    try:
        json.dumps(arguments)
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def _layers(env: Env) -> list[Env]:
    """An environment's wrappers, from the outermost on, and the environment that they wrap."""
    layers = [env]
    while isinstance(layers[-1], gymnasium.Wrapper):
        layers.append(layers[-1].env)
    return layers


def _own_spaces(env: Env) -> list[gymnasium.Space[Any]]:
    """The spaces of an environment and its wrappers, of which code may ``sample``; copies of an environment share none.

    A space that is an attribute of a class is shared by all its objects, and with it the generator of ``sample``.
    """
    found = []
    for layer in _layers(env):
        shared = {name: value for one in reversed(type(layer).__mro__) for name, value in vars(one).items()}
        for name, value in {**shared, **vars(layer)}.items():
            if isinstance(value, gymnasium.Space):
                own = deepcopy(value)
                setattr(layer, name, own)
                found.append(own)
    return found
