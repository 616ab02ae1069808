"""Export of trained networks: files, proof, counts, energy, chips, report (imported as ``switchmt_snn.export``).

``export`` writes a run's network as ONNX and NIR and compares the files with it; ``evaluate_exported`` and
``load_exported`` play the files. ``to_onnx`` and ``to_nir`` do the same in memory, for a run, an agent or a bare
network; ``write_nir`` writes a graph, ``check_parity`` compares. ``profile`` counts what a run's network does while it
plays, prices it and writes a report; ``profile_file`` does so for a NIR file, ``compare_profiles`` for several results.

All of them read one description of the network, ``switchmt_snn.spiking.folding``.
"""

from switchmt_snn.export.export_run import ExportResult, ExportSettings, evaluate_exported, export, load_exported
from switchmt_snn.export.formats.nir_writer import write_nir
from switchmt_snn.export.objects import check_parity, to_nir, to_onnx
from switchmt_snn.export.profile_run import ProfileResult, compare_profiles, profile, profile_file

__all__ = [
    "ExportResult",
    "ExportSettings",
    "ProfileResult",
    "check_parity",
    "compare_profiles",
    "evaluate_exported",
    "export",
    "load_exported",
    "profile",
    "profile_file",
    "to_nir",
    "to_onnx",
    "write_nir",
]
