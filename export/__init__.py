"""Export of trained networks (imported as ``switchmt_snn.export``).

``fold`` makes one chain of layers of a network, ``to_onnx`` and ``to_nir`` write it, ``parity`` compares what was
written with the trained network, and ``run`` does all of it for a run folder. ``profiling`` counts what a network does
while it plays, prices it, and writes a report.
"""

from switchmt_snn.export.export_run import ExportResult, ExportSettings, evaluate_engine, export, load_exported
from switchmt_snn.export.objects import check_parity, to_nir, to_onnx
from switchmt_snn.export.profile_run import Profile, compare_profiles, profile, profile_file

__all__ = [
    "ExportResult",
    "ExportSettings",
    "Profile",
    "check_parity",
    "compare_profiles",
    "evaluate_engine",
    "export",
    "load_exported",
    "profile",
    "profile_file",
    "to_nir",
    "to_onnx",
]
