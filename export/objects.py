"""Export from Python: a run folder, an agent, or a network of one's own becomes ONNX and NIR objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import nir
import numpy as np
import numpy.typing as npt
import onnx
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import ExportError
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.files import obstacles
from switchmt_snn.export.formats.nir_writer import NirDialect, nir_graph
from switchmt_snn.export.formats.onnx_writer import decision_model, step_model
from switchmt_snn.export.parity.compare import Exports
from switchmt_snn.export.parity.proof import prove
from switchmt_snn.export.recording import play
from switchmt_snn.runs.trained import load_agent
from switchmt_snn.spiking.folding import FoldedNetwork, fold, quantized
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.tasks.suite import TaskEnvironment, TaskSuite

Source = str | Path | Agent | QNetwork
"""A run folder, an agent, or a bare network (its tasks are then called ``task_0``, ...)."""


def to_onnx(
    source: Source,
    kind: Literal["decision", "step", "unrolled"] = "decision",
    task: str | None = None,
    int8: bool = False,
) -> onnx.ModelProto:
    """A network as an ONNX model; ``onnx.save(to_onnx(run), path)`` writes it.

    Args:
        source: see ``Source``.
        kind: the whole decision, one simulation step, or the decision without Scan
            (``switchmt_snn.export.formats.onnx_writer``).
        task: fold this task in; None serves all tasks by an input.
        int8: store weights as 8-bit integers.

    Raises:
        ExportError: an ANN has no step and nothing to unroll, or a weight is not finite.
        TaskError: unknown task.

    Examples:
        >>> from switchmt_snn.export import to_onnx
        >>> model = to_onnx("runs/mine")
        >>> [value.name for value in model.graph.input]
        ['observation', 'task']
    """
    network = _folded(source, int8)
    index = None if task is None else network.task_index(task)
    if kind in ("decision", "unrolled"):
        return decision_model(network, index, unroll=kind == "unrolled")
    if kind == "step":
        return step_model(network, index)
    raise ExportError(f"kind is {kind!r}, expected decision, step or unrolled")


def to_nir(source: Source, task: str, dialect: NirDialect = "portable", int8: bool = False) -> nir.NIRGraph:
    """One task of a network as a NIR graph; ``switchmt_snn.export.write_nir`` writes it.

    Args:
        source: see ``Source``.
        task: whose statistics and gains are folded in.
        dialect: see ``switchmt_snn.export.formats.nir_writer``.
        int8: weights rounded to 8 bits (stored as float32; NIR has no integers).

    Raises:
        ExportError: the dialect cannot express the network exactly; the message names one that can.
        TaskError: unknown task.

    Examples:
        >>> from switchmt_snn.export import to_nir
        >>> graph = to_nir("runs/mine", task="CartPole-v1")
        >>> type(graph.nodes["input"]).__name__, int(graph.metadata["timesteps"])
        ('Input', 4)
    """
    network = _folded(source, int8)
    return nir_graph(network, network.task_index(task), dialect)


def check_parity(
    source: Source,
    observations: dict[str, npt.NDArray[Any]] | None = None,
    dialect: NirDialect = "portable",
    int8: bool = False,
) -> dict[str, Any]:
    """Export in memory, in every format that can express the network, and compare with it.

    Args:
        source: see ``Source``.
        observations: raw observations ``[N, *shape]`` by task; None plays 1,000 decisions of each (not for a bare
            network, which has no games).
        dialect: NIR dialect.
        int8: compare a network with rounded weights.

    Returns:
        What ``parity.json`` holds; ``failures`` is empty if everything agrees as it must.

    Raises:
        ExportError: no format can express the network, or observations of a task are missing.
    """
    agent = _agent(source)
    network = fold_agent(agent)
    exported = quantized(network) if int8 else network
    names = agent.suite.names
    left_out = obstacles(network, dialect)
    if len(left_out) == 2:
        raise ExportError(". ".join(left_out.values()))
    graphs = decision = step = None
    if "nir" not in left_out:
        graphs = {name: nir_graph(exported, k, dialect) for k, name in enumerate(names)}
    if "onnx" not in left_out:
        decision = decision_model(exported).SerializeToString()
        step = step_model(exported).SerializeToString() if network.spiking else None
    written = Exports(exported, decision, step, graphs)
    if observations is None:
        evaluation = agent.config.evaluation
        observations = {
            name: play(agent, name, 1000, evaluation.epsilon, evaluation.seed).observations for name in names
        }
    missing = [name for name in names if name not in observations]
    if missing:
        raise ExportError(f"observations of {', '.join(missing)} are missing, expected every task: {', '.join(names)}")
    return prove(agent, written, [observations[name] for name in names])


def _folded(source: Source, int8: bool) -> FoldedNetwork:
    network = fold(source) if isinstance(source, QNetwork) else fold_agent(_agent(source))
    return quantized(network) if int8 else network


def _agent(source: Source) -> Agent:
    if isinstance(source, Agent):
        return source
    return _unnamed(source) if isinstance(source, QNetwork) else load_agent(source, device="cpu")


def _unnamed(network: QNetwork) -> Agent:
    """An agent around a bare network: numbered tasks and actions, and no games to play."""
    seen = network.observation
    channels, *rest = seen.shape

    def make(task: int, num_envs: int) -> TaskEnvironment:
        raise ExportError("a bare network has no games to record, expected observations; pass observations=")

    suite = TaskSuite(
        names=tuple(f"task_{k}" for k in range(seen.num_tasks)),
        frame_shape=(channels // seen.frame_stack, *rest),
        frame_dtype=np.uint8 if seen.in_unit_range else np.float32,
        frame_stack=seen.frame_stack,
        scale=seen.scale,
        in_unit_range=seen.in_unit_range,
        action_names=tuple(f"action_{a}" for a in range(seen.num_actions)),
        valid_actions_KA=np.ones((seen.num_tasks, seen.num_actions), np.bool_),
        references={},
        make=make,
    )
    return Agent(network, suite, ExperimentConfig(network=network.config), torch.device("cpu"), 0)
