"""Export of trained networks (imported as ``switchmt_snn.export``): ONNX, NIR, spike counts, energy.

The package exists so that installs and wheels carry it; the exporters are the subject of the next release
(see CHANGELOG.md).
"""
