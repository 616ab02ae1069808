"""Weights at a chip's precision: what rounding them does to the decisions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.acting.agent import Agent
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.onnx_writer import decision_model
from switchmt_snn.export.parity.compare import Comparison, Exports, compare
from switchmt_snn.spiking.folding import FoldedNetwork
from switchmt_snn.spiking.layers import SynapseNode


def at_precision(network: FoldedNetwork, task: int, bits: int) -> FoldedNetwork:
    """One task's network with symmetric integer weights and one step per layer, as neuromorphic cores have them.

    Everything that multiplies a weight is folded in before rounding. Biases, thresholds and membranes stay float32.
    """
    return network.of_task(task).with_synapses(lambda node: _rounded(node, task, bits))


def _rounded(node: SynapseNode, task: int, bits: int) -> SynapseNode:
    weight, _ = node.folded(task)
    step = max(float(np.abs(weight).max()), np.finfo(np.float32).tiny) / (2 ** (bits - 1) - 1)
    return replace(node, weight=np.rint(weight / step) * step, scale_KO=np.ones_like(node.scale_KO))


def effect_of_precision(agent: Agent, task: int, bits: int, observations: npt.NDArray[Any]) -> Comparison:
    """Decisions with rounded weights against those of the trained network, on raw observations ``[N, *shape]``."""
    name = agent.suite.names[task]
    rounded = at_precision(fold_agent(agent), task, bits)
    model = decision_model(rounded, task).SerializeToString()
    (comparison,) = compare(agent, Exports(rounded, own_decisions={name: model}), task, observations)
    return comparison
