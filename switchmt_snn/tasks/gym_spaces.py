"""What the spaces of a Gymnasium environment mean here: actions, and how an observation becomes a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium
import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import TaskError

ImageLayout = Literal["by_shape", "channels_last", "channels_first"]
FEW_CHANNELS = 4
"""Most channels that an image is expected to have where only its shape tells which axis they are."""

DIM = 32
"""Pixels of 255 up to which an image is called dim."""

LARGEST_WHOLE = 2**24
"""float32 holds every whole number up to this one; of larger ones at best every second."""


@dataclass(frozen=True)
class FrameLayout:
    """How observations become frames.

    Attributes:
        kind: of observations: ``vector``, ``channels_last`` (``[H, W, c]``), ``channels_first`` (``[c, H, W]``) or
            ``grey`` (``[H, W]``).
        shape: of a frame: ``(features,)`` or ``(c, H, W)``.
        scale: factor to the network's input range.
    """

    kind: Literal["vector", "channels_last", "channels_first", "grey"]
    shape: tuple[int, ...]
    scale: float

    @property
    def is_image(self) -> bool:
        """Whether frames are ``(c, H, W)``."""
        return len(self.shape) == 3

    def frame(self, observation: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """An observation as a frame."""
        if self.kind == "channels_last":
            return np.moveaxis(observation, -1, 0)
        return observation[None] if self.kind == "grey" else observation


def channels_last(observation: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """``[H, W, c]`` -> ``[c, H, W]``."""
    return np.moveaxis(observation, -1, 0)


def frame_layout(
    name: str, space: gymnasium.Space[Any], image_layout: ImageLayout, wrappers: Sequence[str] = ()
) -> FrameLayout:
    """How observations of a space become frames.

    Args:
        name: of the task, for errors.
        space: ``observation_space``.
        image_layout: where the channels of images are; ``by_shape`` tells it from the shape, or refuses.
        wrappers: the ones that the task has already, which a remedy keeps.

    Raises:
        TaskError: no ``Box`` of one to three dimensions, an image that is not uint8 or bool, or an image whose shape
            does not say which axis holds the channels.
    """
    flatten = with_wrapper(wrappers, "FlattenObservation")
    if not isinstance(space, gymnasium.spaces.Box):
        raise TaskError(f"task {name!r} observes {in_short(space)}, expected a Box; {_remedy(space, flatten)}")
    shape = tuple(int(side) for side in space.shape)
    if not (1 <= len(shape) <= 3 and all(shape)):
        remedy = flatten if all(shape) else "let it observe something, in a wrapper (tasks.wrappers=[module:Name])"
        raise TaskError(
            f"task {name!r} observes {in_short(space)}, expected a vector or an image (one to three dimensions, none "
            f"empty); {remedy}"
        )
    kind = np.dtype(space.dtype).kind if space.dtype is not None else "f"
    if len(shape) == 1:
        if kind not in "biuf":
            raise TaskError(f"task {name!r} observes {in_short(space)}, expected numbers")
        return FrameLayout("vector", shape, 1.0)
    if not (space.dtype == np.uint8 or kind == "b"):
        raise TaskError(
            f"task {name!r} observes {in_short(space)}, expected uint8 or bool: {len(shape)} dimensions are taken for "
            f"an image; if they are none, {flatten}; if they are, wrap the environment to return uint8"
        )
    scale = 1.0 if kind == "b" else 1.0 / 255.0
    if len(shape) == 2:
        return FrameLayout("grey", (1, *shape), scale)
    if image_layout == "by_shape":
        image_layout = _layout_of(name, shape)
    if image_layout == "channels_first":
        return FrameLayout("channels_first", shape, scale)
    return FrameLayout("channels_last", (shape[2], *shape[:2]), scale)


def rounding(space: gymnasium.Space[Any], largest_seen: float) -> str | None:
    """What a user should know where vectors hold numbers that float32, which networks take, rounds to others.

    Args:
        space: ``observation_space``.
        largest_seen: the largest absolute value of a play.

    Examples:
        >>> rounding(gymnasium.spaces.Box(0, 255, (2,), np.int32), 0.0) is None
        True
    """
    kind = np.dtype(space.dtype)
    if not isinstance(space, gymnasium.spaces.Box) or np.can_cast(kind, np.float32):
        return None
    declared = max(abs(int(np.min(space.low))), abs(int(np.max(space.high)))) if kind.kind in "iu" else 0
    if max(declared, largest_seen) < LARGEST_WHOLE:
        return None
    source = f"declares whole numbers up to {declared:,}" if declared else f"is {kind}, and gave {largest_seen:,.0f}"
    return (
        f"its observation_space {source}; networks take float32, which rounds whole numbers above {LARGEST_WHOLE:,}; "
        "declare the bounds that they have, or scale or split them in a wrapper (tasks.wrappers)"
    )


class RoundedObservation(UserWarning):
    """Observations hold numbers that float32 rounds to others."""


def dim_pixels(scale: float, high: float) -> str | None:
    """What a user should know where an image has values that, scaled, hardly reach the network.

    Examples:
        >>> dim_pixels(1 / 255, 1)
        'pixels up to 1 of 255: the network sees 0.0039 at most; spread them in a wrapper (tasks.wrappers)'
    """
    if scale == 1.0 or high > DIM:
        return None
    return (
        f"pixels up to {high:g} of 255: the network sees {high * scale:.2g} at most; spread them in a wrapper "
        "(tasks.wrappers)"
    )


def with_wrapper(wrappers: Sequence[str], wrapper: str) -> str:
    """What to do, where one more wrapper helps: the whole list, as the setting takes it.

    Examples:
        >>> with_wrapper(["FlattenAction"], "FlattenObservation")
        'set tasks.wrappers=[FlattenAction,FlattenObservation]'
    """
    return f"set tasks.wrappers=[{','.join((*wrappers, wrapper))}]"


def _layout_of(name: str, shape: tuple[int, ...]) -> ImageLayout:
    """Channels are the axis beside two equal sides, or the only end that is at most 4; if the two disagree: refused."""
    first, middle, last = shape
    signs: set[ImageLayout] = set()
    if first == middle != last:
        signs.add("channels_last")
    if last == middle != first:
        signs.add("channels_first")
    if last <= FEW_CHANNELS < first:
        signs.add("channels_last")
    if first <= FEW_CHANNELS < last:
        signs.add("channels_first")
    if len(signs) != 1:
        raise TaskError(
            f"task {name!r} observes images of shape {shape}, which does not say which axis holds the channels; set "
            "tasks.image_layout to channels_last or channels_first"
        )
    return signs.pop()


MOST_ACTIONS = 100_000
"""Of a task: a Q-network has an output for each."""


def num_actions(name: str, space: gymnasium.Space[Any], wrappers: Sequence[str] = ()) -> int:
    """Actions of a task.

    Raises:
        TaskError: they are not ``Discrete``.
    """
    if isinstance(space, gymnasium.spaces.Discrete):
        if space.n > MOST_ACTIONS:
            raise TaskError(
                f"task {name!r} has {space.n:,} actions, expected at most {MOST_ACTIONS:,}: a Q-network has an output "
                "for each; choose some in a wrapper of your own (gymnasium.ActionWrapper; tasks.wrappers=[module:Name])"
            )
        return int(space.n)
    remedy = "choose some actions in a wrapper of your own (gymnasium.ActionWrapper; tasks.wrappers=[module:Name])"
    if isinstance(space, (gymnasium.spaces.MultiDiscrete, gymnasium.spaces.MultiBinary)):
        remedy = f"{with_wrapper(wrappers, 'FlattenAction')}, which makes one action of every combination"
    raise TaskError(
        f"task {name!r} has the action space {in_short(space)}, expected Discrete: a Q-network lists actions; {remedy}"
    )


def _remedy(space: gymnasium.Space[Any], flatten: str) -> str:
    try:
        flattens = space.is_np_flattenable
    except NotImplementedError:  # of a space that the environment's package made
        flattens = False
    if flattens:
        return flatten
    return (
        "choose its numbers in a wrapper (tasks.wrappers=[module:Name]): one of the environment's package, such as "
        "minigrid.wrappers:ImgObsWrapper, or a gymnasium.ObservationWrapper of your own"
    )


def in_short(space: object) -> str:
    """A space, or its text, in one short line."""
    text = " ".join(str(space).split())
    return text if len(text) <= 120 else f"{text[:117]}..."
