"""Agents that are watched while they play: the trained network or its exported files, with the spikes of parity checks.

One decision is one pass of the network: the Q-values that act and the spikes that are shown come from it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnxruntime
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.acting.watching import Insight
from switchmt_snn.export.export_run import exported_as, step_session
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.parity.activity import active_neurons
from switchmt_snn.export.parity.compare import Trace, trace_nir, trace_onnx
from switchmt_snn.export.runtimes.agents import NirAgent, OnnxAgent, encode, existing_only
from switchmt_snn.runs.packing import open_run
from switchmt_snn.runs.trained import load_agent
from switchmt_snn.spiking.folding import FoldedNetwork

Tracer = Callable[[npt.NDArray[Any], int, int], Trace]
"""Observations ``[B, *shape]``, a task and the seed of a random encoding -> Q-values and spikes."""


class Watched:
    """A ``WatchedAgent``: it decides by a tracer, and keeps what the tracer saw."""

    def __init__(self, agent: Agent, tracer: Callable[[Agent], Tracer], runtime: str) -> None:
        """Watch an agent.

        Args:
            agent: the trained network; its suite names the tasks.
            tracer: makes what decides (the network itself, or its files); called once for each thread.
            runtime: name of what decides.
        """
        self.agent, self.runtime = agent, runtime
        self.suite, self.step = agent.suite, agent.step
        self._make, self._trace, self._seed = tracer, tracer(agent), agent.config.seed
        self.insight = Insight(np.zeros(0, np.float32), None, {})

    def independent(self) -> Watched:
        """The same for another thread."""
        return Watched(self.agent.independent(), self._make, self.runtime)

    @property
    def draws(self) -> bool:
        """As the agent."""
        return self.agent.draws

    def reseed(self, seed: int) -> None:
        """The seed from which a random encoding draws the next decision's numbers."""
        self._seed = seed

    def q_values(self, observation: npt.NDArray[Any], task: str | int) -> npt.NDArray[np.float32]:
        """Q-values ``[B, A]``, -inf where an action does not exist; ``insight`` is that of the first observation."""
        index = self.suite.index(task)
        trace = self._trace(np.ascontiguousarray(observation), index, self._seed)
        q_BA = existing_only(trace.q_BA, self.suite.valid_actions_KA[index])
        active = {name: values_TBN[:, 0] for name, values_TBN in trace.spikes.items()}
        self.insight = Insight(q_BA[0], _value(self.agent, active, index), active)
        return q_BA


def watched_agent(run: str | Path | None = None, runtime: str = "torch", checkpoint: str = "last") -> Watched:
    """A run's agent, or its exported files, watched.

    Args:
        run: run folder, or ``pretrained/NAME``; None takes the newest run under ``runs/``.
        runtime: ``torch``: the trained network. ``onnx``: ``export/decision.onnx``, with the spikes of
            ``export/step.onnx``. ``nir``: ``export/TASK.nir`` in the reference interpreter.
        checkpoint: ``last`` or ``best``; exported files must be of the same training step.

    Raises:
        ExportError: an unknown runtime; the run was not exported, or its files are of another training step.
    """
    folder = open_run(run)
    agent = load_agent(folder.path, checkpoint, "cpu")
    if runtime == "torch":
        return Watched(agent, trace_network, runtime)
    played, network = exported_as(agent, folder, runtime, checkpoint), fold_agent(agent)
    if isinstance(played, NirAgent):
        return Watched(agent, lambda agent: tracer_of_nir(agent, network, played), runtime)
    step = step_session(folder, checkpoint) if network.spiking else None
    return Watched(agent, lambda agent: tracer_of_onnx(agent, network, played, step), runtime)


def tracer_of_nir(agent: Agent, network: FoldedNetwork, played: NirAgent) -> Tracer:
    """NIR files in the reference interpreter."""

    def trace(observations: npt.NDArray[Any], task: int, seed: int) -> Trace:
        encoded_TB = encode(agent.suite, agent.config, observations, seed)
        return trace_nir(network, played.interpreters[agent.suite.names[task]], encoded_TB)

    return trace


def tracer_of_onnx(
    agent: Agent, network: FoldedNetwork, played: OnnxAgent, step: onnxruntime.InferenceSession | None
) -> Tracer:
    """``decision.onnx``, with the spikes of ``step.onnx``; without it there are none."""

    def trace(observations: npt.NDArray[Any], task: int, seed: int) -> Trace:
        encoded_TB = encode(agent.suite, agent.config, observations, seed)
        return trace_onnx(network, played, step, observations, encoded_TB, task)

    return trace


def trace_network(agent: Agent) -> Tracer:
    """The trained network itself."""

    def trace(observations: npt.NDArray[Any], task: int, seed: int) -> Trace:
        activity = active_neurons(agent, observations, task, seed)
        return Trace(activity.q_BA, activity.by_layer)

    return trace


def _value(agent: Agent, active: dict[str, npt.NDArray[np.bool_]], task: int) -> float | None:
    """The value head on the hidden spikes that were seen; None where they were not, or are no spikes."""
    network = agent.network
    if "hidden" not in active or not network.spiking:
        return None
    width = active["hidden"].shape[1] // len(network.streams)
    first = list(network.streams).index("value") * width if "value" in network.streams else 0
    with torch.inference_mode():
        spikes_TBN = torch.from_numpy(active["hidden"][:, None, first : first + width]).to(agent.device, torch.float32)
        value = network.value(spikes_TBN, task)
    return None if value is None else float(value[0])
