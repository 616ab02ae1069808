"""The files of a network before they are on the disk. Whether a format can express a network is asked of its writer."""

from __future__ import annotations

from collections.abc import Callable

import nir
import onnx

from switchmt_snn.errors import ExportError
from switchmt_snn.export.formats.nir_writer import NirDialect, nir_graph
from switchmt_snn.export.formats.onnx_writer import decision_model, step_model
from switchmt_snn.runs.files import file_name
from switchmt_snn.spiking.folding import FoldedNetwork


def onnx_models(
    network: FoldedNetwork, specialised: tuple[str, ...] = (), unroll: bool = False
) -> dict[str, onnx.ModelProto]:
    """``decision``, ``step`` if the network spikes, ``decision_<task>`` for some tasks, ``unrolled``; by file name.

    Raises:
        ExportError: ONNX cannot express the network.
    """
    models = {"decision.onnx": decision_model(network)}
    if network.spiking:
        models["step.onnx"] = step_model(network)
    if unroll:
        models["unrolled.onnx"] = decision_model(network, unroll=True)
    for task in specialised:
        models[f"decision_{file_name(task)}.onnx"] = decision_model(network, network.task_index(task))
    return models


def nir_graphs(network: FoldedNetwork, dialect: NirDialect = "portable") -> dict[str, nir.NIRGraph]:
    """A graph for each task, by the task's name.

    Raises:
        ExportError: the dialect cannot express the network.
    """
    return {task: nir_graph(network, index, dialect) for index, task in enumerate(network.tasks)}


def obstacles(network: FoldedNetwork, dialect: NirDialect = "portable") -> dict[str, str]:
    """What keeps a network from a format, by format (``onnx``, ``nir``); empty if both can express it exactly."""
    writers: dict[str, Callable[[], object]] = {
        "onnx": lambda: onnx_models(network),
        "nir": lambda: nir_graphs(network, dialect),
    }
    found = {}
    for name, write in writers.items():
        try:
            write()
        except ExportError as error:
            found[name] = str(error)
    return found
