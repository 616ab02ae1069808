"""A short stretch of play to look at: consecutive decisions, and which neurons fired at each simulation step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.acting.agent import Agent
from switchmt_snn.export.parity.activity import active_neurons
from switchmt_snn.export.recording import COPIES, Recording

DECISIONS = 8
NEURONS_PER_LAYER = 48


@dataclass(frozen=True)
class LayerSample:
    """Some neurons of a layer.

    Attributes:
        neurons: indices into the layer's flattened output, evenly taken from those that fired in the stretch.
        fired: how many neurons fired in the stretch.
        of: neurons of the layer.
        spikes: for each neuron a string of 0 and 1, one per simulation step, decision after decision.
    """

    layer: str
    neurons: tuple[int, ...]
    fired: int
    of: int
    spikes: tuple[str, ...]


@dataclass(frozen=True)
class Sample:
    """A stretch of one task's recorded play.

    Attributes:
        first_decision: index of its first decision in the recording.
        actions: names of what was done.
        rewards: raw reward of each action.
        frames: newest frame of each observation ``[n, *frame_shape]``.
    """

    first_decision: int
    actions: tuple[str, ...]
    rewards: tuple[float, ...]
    layers: tuple[LayerSample, ...]
    frames: npt.NDArray[Any]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, without the frames."""
        return {
            "first_decision": self.first_decision,
            "actions": list(self.actions),
            "rewards": list(self.rewards),
            "layers": [vars(layer) for layer in self.layers],
        }


def take_sample(agent: Agent, task: int, recording: Recording) -> Sample:
    """The stretch in the middle of the first copy's play."""
    stretch = len(recording.actions) // COPIES
    count = min(DECISIONS, stretch)
    first = (stretch - count) // 2
    chosen = slice(first, first + count)
    observations = np.ascontiguousarray(recording.observations[chosen])
    by_layer = active_neurons(agent, observations, task, seed=0).by_layer
    channels = agent.suite.frame_shape[0]
    return Sample(
        first_decision=first,
        actions=tuple(agent.suite.action_names[action] for action in recording.actions[chosen]),
        rewards=() if recording.rewards is None else tuple(recording.rewards[chosen].tolist()),
        layers=tuple(_layer_sample(name, active_TBN) for name, active_TBN in by_layer.items()),
        frames=observations[:, -channels:],
    )


def _layer_sample(name: str, active_TBN: npt.NDArray[np.bool_]) -> LayerSample:
    steps_SN = active_TBN.swapaxes(0, 1).reshape(-1, active_TBN.shape[2])  # decision after decision
    fired = np.flatnonzero(steps_SN.any(axis=0))
    shown = fired[np.linspace(0, len(fired) - 1, min(NEURONS_PER_LAYER, len(fired))).astype(np.int64)]
    spikes = tuple("".join("1" if on else "0" for on in steps_SN[:, neuron]) for neuron in shown)
    return LayerSample(name, tuple(shown.tolist()), len(fired), steps_SN.shape[1], spikes)
