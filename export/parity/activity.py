"""The trained network's own activity on a batch of decisions, layer by layer, as an export names its layers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.export.runtimes.agents import existing_only

CHUNK = 32
"""Decisions that are held in memory at once."""


@dataclass(frozen=True)
class Activity:
    """What a batch of decisions did.

    Attributes:
        q_BA: Q-values ``[B, A]``, -inf where an action does not exist.
        by_layer: which neurons were not zero ``[T, B, N]``, in forward order; the streams side by side as ``hidden``.
    """

    q_BA: npt.NDArray[np.float32]
    by_layer: dict[str, npt.NDArray[np.bool_]]


def active_neurons(agent: Agent, observations: npt.NDArray[Any], task: int, seed: int) -> Activity:
    """Run the network in eval mode on raw observations ``[B, *shape]``; ``seed`` is of a random encoding."""
    activity: dict[str, torch.Tensor] = {}
    agent.network.eval()
    with torch.inference_mode():
        generator = torch.Generator().manual_seed(seed)
        q_BA = agent.network(torch.from_numpy(observations), task, activity=activity, generator=generator)
    q = existing_only(q_BA.numpy(), agent.suite.valid_actions_KA[task])
    parts: dict[str, list[npt.NDArray[np.bool_]]] = {}
    for name, values in activity.items():
        layer = name if name in agent.network.trunk else "hidden"
        parts.setdefault(layer, []).append(values.flatten(2).numpy() != 0)
    return Activity(q, {name: np.concatenate(layers, axis=2) for name, layers in parts.items()})


def chunks(observations: npt.NDArray[Any]) -> Iterator[npt.NDArray[Any]]:
    """Batches of at most ``CHUNK`` decisions."""
    for start in range(0, len(observations), CHUNK):
        yield np.ascontiguousarray(observations[start : start + CHUNK])
