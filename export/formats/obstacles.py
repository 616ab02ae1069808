"""Which formats cannot express a network, and why."""

from __future__ import annotations

from switchmt_snn.errors import ExportError
from switchmt_snn.export.formats.nir_writer import NirDialect, nir_graph
from switchmt_snn.export.formats.onnx_writer import decision_model
from switchmt_snn.spiking.folding import FoldedNetwork


def obstacles(network: FoldedNetwork, dialect: NirDialect = "portable") -> dict[str, str]:
    """What keeps a network from a format, by format (``onnx``, ``nir``); empty if both can express it exactly."""
    found = {}
    for name, write in (("onnx", lambda: decision_model(network)), ("nir", lambda: nir_graph(network, 0, dialect))):
        try:
            write()
        except ExportError as error:
            found[name] = str(error)
    return found
