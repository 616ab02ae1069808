"""Observations that a caller hands to an agent, as the raw numbers that its network learned on."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.masked import FILL, has_masked_values
from switchmt_snn.tasks.suite import TaskSuite


def raw_batch(suite: TaskSuite, observation: Any) -> tuple[npt.NDArray[Any], bool]:
    """Observations as a batch ``[B, *suite.observation_shape]`` of ``suite.frame_dtype``, and whether it was given one.

    Args:
        suite: of the agent.
        observation: array, tensor or list of numbers: ``suite.observation_shape`` or a batch of it. Without stacked
            frames also one image as its environment gives it: ``[H, W]`` or ``[H, W, c]``.

    Raises:
        TaskError: another shape, no numbers, or numbers that a task of the suite cannot have given.
    """
    array = _channels_first(suite, _array(observation))
    expected = suite.observation_shape
    single = array.shape == expected
    if not single and array.shape[1:] != expected:
        raise TaskError(
            f"the observation has shape {array.shape}, expected {expected} or (batch, "
            f"{', '.join(map(str, expected))}): stacked frames, channels first, raw values"
        )
    numbers = _in_type(suite, array)
    return (numbers[None] if single else numbers), single


def _array(observation: Any) -> npt.NDArray[Any]:
    if isinstance(observation, torch.Tensor):
        tensor = observation.detach().cpu()
        return np.asarray((tensor.float() if tensor.is_floating_point() else tensor).numpy())
    if has_masked_values(observation):
        raise TaskError(f"the observation is a masked array, expected plain numbers; {FILL}")
    try:
        return np.asarray(observation)
    except (ValueError, TypeError):  # lists of unequal lengths
        return np.asarray(None)


def _channels_first(suite: TaskSuite, observation: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """One image whose shape says that its channels are last, or left out, with its channels first."""
    channels, *image = suite.observation_shape
    if len(image) != 2 or suite.frame_stack != 1 or observation.shape == suite.observation_shape:
        return observation
    if channels == 1 and observation.shape == tuple(image):
        return observation[None]
    return np.moveaxis(observation, -1, 0) if observation.shape == (*image, channels) else observation


def _in_type(suite: TaskSuite, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    dtype = np.dtype(suite.frame_dtype)
    if array.dtype == dtype == np.uint8 and not (suite.in_unit_range and 255 * suite.scale > 1):
        return array
    if array.dtype.kind not in ("biu" if dtype == np.uint8 else "biuf"):
        expected = f"raw numbers ({dtype})" if dtype != np.uint8 else "raw bytes, as the environment gives them (uint8)"
        raise TaskError(f"the observation is of type {array.dtype}, expected {expected}")
    low, high = (array.min(), array.max()) if array.size else (0, 0)  # NaN if one value is
    most = int(1 / suite.scale + 0.5) if suite.in_unit_range else 255
    if dtype == np.uint8:
        if low < 0 or high > most:
            raise TaskError(f"the observation has values from {low} to {high}, expected raw ones from 0 to {most}")
        return array.astype(np.uint8)
    largest = float(np.finfo(dtype).max)
    if not (-largest <= float(low) and float(high) <= largest):
        raise TaskError(f"the observation has values from {low:g} to {high:g}, expected finite numbers ({dtype})")
    return array.astype(dtype, copy=False)
