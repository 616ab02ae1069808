"""Agents whose network can be watched while it decides: what a film of a run needs of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.acting.evaluation import DecisionMaker


@dataclass(frozen=True)
class Insight:
    """What a network did for one decision.

    Attributes:
        q_A: Q-values ``[A]``, -inf where an action does not exist.
        value: of the state; None without a value stream, or where the readout leaves no single value.
        active: which neurons fired (of an ANN, were not zero) at each simulation step ``[T, N]``, by layer in forward
            order. Empty if what decides does not show it.
    """

    q_A: npt.NDArray[np.float32]
    value: float | None
    active: dict[str, npt.NDArray[np.bool_]]

    @property
    def advantage_A(self) -> npt.NDArray[np.float32] | None:
        """``Q - V`` of each action: the advantage stream's output less its mean; None without a value."""
        return None if self.value is None else self.q_A - np.float32(self.value)


class WatchedAgent(DecisionMaker, Protocol):
    """An agent that remembers how it came to its last decision.

    Attributes:
        agent: the trained network of the run.
        runtime: what decides: ``torch``, ``onnx`` or ``nir``.
        insight: of the last decision that ``q_values`` was asked for.
    """

    agent: Agent
    runtime: str
    insight: Insight


def gains_of(agent: Agent, task: int) -> dict[str, npt.NDArray[np.float32]]:
    """Gains of the active dendrites for a task by stream, ``[N]`` or (shared) ``[1]``; empty without dendrites."""
    gains: dict[str, npt.NDArray[np.float32]] = {}
    for name, stream in agent.network.streams.items():
        dendrites: Any = stream.dendrites
        if dendrites is not None:
            with torch.inference_mode():
                gain: torch.Tensor = dendrites(task)
            gains[name] = gain.cpu().numpy()
    return gains
